"""Networks that see their inputs in units of their spread, and the same networks without."""

from __future__ import annotations

import copy

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from torchrl_morl.modules.inputs import NamedInputsMLP
from torchrl_morl.modules.networks import PreciseLinear

__all__ = ["StandardizedLinear", "fold_standardization", "standardize_inputs"]


class StandardizedLinear(PreciseLinear):
    """A linear layer of ``(input - loc) / scale``.

    What is measured in large units, such as the speeds of joints, would else decide alone what a network
    does at first. Statistics are buffers: they are in the state dict, and no optimizer changes them.

    Args:
        in_features (int): size of the input.
        out_features (int): size of the output.
        loc (Tensor): means ``[F]`` of the first ``F`` entries; further ones stay as they are.
        scale (Tensor): their standard deviations ``[F]``.
        device (torch.device, optional): where it lives.

    Raises:
        ValueError: if the statistics do not fit, are not finite, or a deviation is not positive.

    Example:
        >>> layer = StandardizedLinear(3, 1, torch.tensor([5.0]), torch.tensor([2.0]))
        >>> layer
        StandardizedLinear(in_features=3, out_features=1, bias=True, standardized=1)

    """

    def __init__(
        self,
        in_features: int,
        out_features: int,
        loc: Tensor,
        scale: Tensor,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__(in_features, out_features, device=device)
        if loc.ndim != 1 or loc.shape != scale.shape or len(loc) > in_features:
            raise ValueError(
                f"loc and scale must both have shape [F] with F at most {in_features}, the inputs of the "
                f"layer, got {list(loc.shape)} and {list(scale.shape)}."
            )
        if not (loc.isfinite().all() and scale.isfinite().all() and (scale > 0).all()):
            raise ValueError(
                f"loc must be finite and scale positive, got {loc.tolist()} and {scale.tolist()}."
            )
        self._standardized = len(loc)
        others = in_features - len(loc)
        like = self.weight
        self.register_buffer("loc", torch.cat((loc.to(like), like.new_zeros(others))))
        self.register_buffer("scale", torch.cat((scale.to(like), like.new_ones(others))))

    def forward(self, input: Tensor) -> Tensor:
        """Inputs ``[*B, in_features]`` to outputs ``[*B, out_features]``."""
        return super().forward((input - self.loc) / self.scale)

    def folded(self) -> nn.Linear:
        """A plain layer that computes the same, with weights of its own."""
        plain = PreciseLinear(self.in_features, self.out_features, device=self.weight.device)
        with torch.no_grad():
            plain.weight.copy_(self.weight / self.scale)
            plain.bias.copy_(self.bias - plain.weight @ self.loc)
        return plain

    def extra_repr(self) -> str:
        return f"{super().extra_repr()}, standardized={self._standardized}"


def standardize_inputs(network: TensorDictModuleBase, loc: Tensor, scale: Tensor) -> None:
    """Let a network see its first inputs in units of their spread, in place.

    Before it is trained: what it computes changes. The weights that it has stay.

    Args:
        network (TensorDictModuleBase): of :func:`make_actor` or :func:`make_vector_critic`.
        loc (Tensor): means ``[F]`` of the first ``F`` entries of its inputs, in the order of ``in_keys``.
        scale (Tensor): their standard deviations ``[F]``.

    Raises:
        ValueError: if the network is of another kind or has been standardized, or the statistics do not
            fit.

    Example:
        >>> from torchrl.data import Bounded
        >>> from torchrl_morl.modules import make_actor
        >>> actor = make_actor(Bounded(-1.0, 1.0, (2,)), in_features=4, num_cells=(8,))
        >>> standardize_inputs(actor, loc=torch.zeros(3), scale=torch.full((3,), 10.0))
        >>> actor[0].module[0]
        StandardizedLinear(in_features=4, out_features=8, bias=True, standardized=3)

    """
    mlp = _perceptron(network)
    if isinstance(mlp[0], StandardizedLinear):
        raise ValueError("the inputs of this network are standardized already.")
    old = mlp[0]
    new = StandardizedLinear(
        old.in_features, old.out_features, loc, scale, device=old.weight.device
    )
    new.weight, new.bias = old.weight, old.bias
    mlp[0] = new


def fold_standardization(network: TensorDictModuleBase) -> TensorDictModuleBase:
    """A copy that computes the same with plain layers, as files of policies hold them.

    Args:
        network (TensorDictModuleBase): with standardized inputs or without.

    Example:
        >>> from torchrl.data import Bounded
        >>> from torchrl_morl.modules import make_actor
        >>> actor = make_actor(Bounded(-1.0, 1.0, (2,)), in_features=4, num_cells=(8,))
        >>> standardize_inputs(actor, loc=torch.ones(3), scale=torch.full((3,), 10.0))
        >>> plain = fold_standardization(actor)
        >>> given = {"observation": torch.randn(5, 3), "preference": torch.rand(5, 1)}
        >>> torch.allclose(plain(*given.values())[1], actor(*given.values())[1], atol=1e-6)
        True

    """
    network = copy.deepcopy(network)
    mlp = _perceptron(network)
    if isinstance(mlp[0], StandardizedLinear):
        mlp[0] = mlp[0].folded()
    return network


def _perceptron(network: nn.Module) -> NamedInputsMLP:
    found = [module for module in network.modules() if isinstance(module, NamedInputsMLP)]
    if len(found) != 1:
        raise ValueError(
            f"the network must be of make_actor or make_vector_critic, got a {type(network).__name__} "
            f"with {len(found)} of their perceptrons."
        )
    return found[0]
