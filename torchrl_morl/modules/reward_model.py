"""A bounded reward that is learned from ranked behaviour."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import Composite, TensorSpec

from torchrl_morl.arguments import check_count, check_device, check_sizes, key_list
from torchrl_morl.modules.inputs import NamedInputsMLP, resolve_in_features
from torchrl_morl.modules.networks import _ScaledLinear, keep_precision

__all__ = ["RewardModel"]


class RewardModel(TensorDictModule):
    r"""A learned reward :math:`R(s, a) \in [0, 1]`, the mean of one or several sigmoid networks.

    .. math::
        R(s, a) = \frac{1}{M} \sum_{m=1}^{M} \mathrm{sigmoid}(f_m(s, a))

    It is trained with :class:`~torchrl_morl.objectives.BradleyTerryLoss` on ranked snippets and then,
    frozen, becomes an entry of the vector reward through
    :class:`~torchrl_morl.transforms.RewardModelReward`. The last layers start small and without a
    bias, so that R is about 0.5 everywhere: a sigmoid that starts at its ends has no gradient.

    What R can depend on is decided by ``in_keys`` alone: ``("observation",)`` gives a state-only
    reward, and leaving out the key of the human gives one that cannot know about people. Inputs that
    tell the time or the absolute position invite R to rank by them instead of by behaviour.

    The parameters are created at once (no lazy layers). Keys of the state dict, with ``n`` hidden
    layers and for each member ``m``: ``module.members.{m}.{0, 2, ..., 2n}.{weight, bias}``.

    Args:
        observation_spec (Composite, optional): holds the inputs other than the action, which gives
            their sizes.
        action_spec (TensorSpec, optional): gives the size of the action, if that is an input.

    Keyword Args:
        in_features (int, optional): the summed size of all inputs, instead of specs.
        in_keys (Sequence[NestedKey]): the inputs of shape ``[*B, F_i]``, in the order of
            concatenation.
        num_cells (Sequence[int]): the sizes of the hidden layers.
        activation_class (type[nn.Module]): the activation of the hidden layers.
        out_key (NestedKey): where R of shape ``[*B, 1]`` is written.
        num_members (int): the number ``M`` of networks, each with its own initialisation. They are
            trained jointly, through their mean.
        last_layer_gain (float): factor on the initial weights of the last layers.
        action_key (NestedKey): the input whose size ``action_spec`` gives.
        device (torch.device, optional): where the parameters live.

    Raises:
        ValueError: if there is less than one member, or if the sizes of the inputs do not follow from
            the specs; at a call, for inputs of another size or precision.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> model = RewardModel(in_features=4 + 2, num_cells=(16,), num_members=3)
        >>> data = TensorDict(observation=torch.randn(5, 4), action=torch.rand(5, 2), batch_size=5)
        >>> score = model(data)["demo_score"]
        >>> score.shape, bool(((score - 0.5).abs() < 0.02).all())
        (torch.Size([5, 1]), True)

    """

    def __init__(
        self,
        observation_spec: Composite | None = None,
        action_spec: TensorSpec | None = None,
        *,
        in_features: int | None = None,
        in_keys: Sequence[NestedKey] = ("observation", "action"),
        num_cells: Sequence[int] = (256, 256, 256, 256),
        activation_class: type[nn.Module] = nn.ReLU,
        out_key: NestedKey = "demo_score",
        num_members: int = 1,
        last_layer_gain: float = 0.01,
        action_key: NestedKey = "action",
        device: torch.device | str | None = None,
    ) -> None:
        check_count("num_members", num_members, most=10_000)
        in_keys = key_list(in_keys)
        in_features = resolve_in_features(
            in_features, in_keys, observation_spec, action_spec, action_key
        )
        check_sizes(in_features, num_cells)
        check_device("device", device, holds_values=False)
        members = []
        for _ in range(num_members):
            mlp = NamedInputsMLP(
                in_keys,
                in_features=in_features,
                out_features=1,
                num_cells=list(num_cells),
                activation_class=activation_class,
                device=device,
            )
            if num_cells:
                keep_precision(mlp, 0)
            mlp[-1] = _ScaledLinear(mlp[-1].in_features, 1, gain=last_layer_gain, device=device)
            members.append(mlp)
        super().__init__(_MeanSigmoid(members), in_keys=in_keys, out_keys=[out_key])

    @property
    def in_features(self) -> int:
        """The summed size of all inputs."""
        return self.module.members[0][0].in_features


class _MeanSigmoid(nn.Module):
    """Mean over networks of their sigmoid."""

    def __init__(self, members: Sequence[nn.Module]) -> None:
        super().__init__()
        self.members = nn.ModuleList(members)

    def forward(self, *inputs: Tensor) -> Tensor:
        # A loop: a few members of four wide layers are bound by the products, not by the calls.
        return torch.stack([member(*inputs) for member in self.members]).sigmoid().mean(0)
