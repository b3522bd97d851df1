"""Actor and vector critic of a preference-conditioned agent."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import Bounded, Composite, TensorSpec
from torchrl.modules import TanhModule

from torchrl_morl.arguments import check_count, check_device, check_sizes, key_list
from torchrl_morl.modules.inputs import NamedInputsMLP, resolve_in_features

__all__ = ["make_actor", "make_vector_critic", "saturated_fraction"]


class PreciseLinear(nn.Linear):
    """A linear layer in the precision of its weights, also under :class:`torch.autocast`.

    First and last layers of a network are such: bfloat16 has three digits, which round metres to
    centimetres, and values and actions are compared in their last ones.
    """

    def forward(self, input: Tensor) -> Tensor:
        device = input.device.type
        if not torch.is_autocast_enabled(device):
            return super().forward(input)
        with torch.autocast(device, enabled=False):
            return super().forward(input.to(self.weight.dtype))


class _ScaledLinear(PreciseLinear):
    """A linear layer that starts, and restarts, with small weights and no bias.

    The gain lives in ``reset_parameters``, and not in a one-off edit of the weights, so that it
    survives ``reset_parameters_recursive`` of a loss module.
    """

    def __init__(self, in_features: int, out_features: int, gain: float, **kwargs) -> None:
        # Set first: nn.Linear calls reset_parameters from its constructor.
        self.gain = gain
        super().__init__(in_features, out_features, **kwargs)

    def reset_parameters(self) -> None:
        super().reset_parameters()
        with torch.no_grad():
            self.weight.mul_(self.gain)
            self.bias.zero_()


def make_actor(
    action_spec: TensorSpec,
    observation_spec: Composite | None = None,
    *,
    in_features: int | None = None,
    in_keys: Sequence[NestedKey] = ("observation", "preference"),
    num_cells: Sequence[int] = (256, 256, 256, 256),
    activation_class: type[nn.Module] = nn.ReLU,
    out_key: NestedKey = "action",
    pre_tanh_key: NestedKey = "pre_tanh",
    last_layer_gain: float = 0.01,
    device: torch.device | str | None = None,
) -> TensorDictSequential:
    """Build a deterministic actor ``(state, preference) -> action``.

    An MLP over the concatenated inputs writes the pre-tanh output, and a
    :class:`~torchrl.modules.TanhModule` maps it to the bounds of the action. The pre-tanh output is
    kept under its own key, so that a loss can penalise it: an actor that saturates has no gradient
    left and does the same in every state and for every preference. Under :class:`torch.autocast` the
    first and the last layer keep the precision of their weights, and so does the action.

    The parameters are created at once (no lazy layers). Keys of the state dict, with ``n`` hidden
    layers: ``module.0.module.{0, 2, ..., 2n}.{weight, bias}`` and the bounds
    ``module.1.{out_key}_{low, high}``.

    Args:
        action_spec (TensorSpec): a :class:`~torchrl.data.Bounded` spec, or a composite that holds
            one at ``out_key``. Batch dimensions are dropped; the bounds must agree across them.
        observation_spec (Composite, optional): holds the inputs, which gives their sizes.

    Keyword Args:
        in_features (int, optional): the summed size of all inputs, instead of an observation spec.
        in_keys (Sequence[NestedKey]): the inputs, in the order of concatenation.
        num_cells (Sequence[int]): the sizes of the hidden layers.
        activation_class (type[nn.Module]): the activation of the hidden layers.
        out_key (NestedKey): where the action is written.
        pre_tanh_key (NestedKey): where the input of the tanh is written.
        last_layer_gain (float): factor on the initial weights of the last layer; its bias starts at
            zero. With a small gain every action starts at the centre of its range.
        device (torch.device, optional): where the parameters live.

    Returns:
        A module that reads ``in_keys`` and writes ``pre_tanh_key`` and ``out_key``.

    Raises:
        ValueError: if the action spec is not bounded, or has different bounds within the batch; if
            the sizes of the inputs do not follow from the spec; at a call, for inputs of another size
            or precision.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from torchrl_morl.preferences import PreferenceSpace
        >>> from torchrl_morl.testing import VectorRewardMockEnv
        >>> from torchrl_morl.transforms import PreferenceSampler
        >>> sampler = PreferenceSampler(PreferenceSpace(("left", "ahead", "right")))
        >>> env = TransformedEnv(VectorRewardMockEnv(3, batch_size=(4,)), sampler)
        >>> actor = make_actor(env.action_spec, env.observation_spec, num_cells=(16,))
        >>> env.rollout(5, actor)["action"].shape
        torch.Size([4, 5, 2])

    """
    in_keys = key_list(in_keys)
    in_features = resolve_in_features(in_features, in_keys, observation_spec)
    check_sizes(in_features, num_cells)
    check_device("device", device, holds_values=False)
    low, high = _action_bounds(action_spec, out_key)
    mlp = NamedInputsMLP(
        in_keys,
        in_features=in_features,
        out_features=low.shape[-1],
        num_cells=list(num_cells),
        activation_class=activation_class,
        device=device,
    )
    if num_cells:
        keep_precision(mlp, 0)
    mlp[-1] = _ScaledLinear(
        mlp[-1].in_features, mlp[-1].out_features, gain=last_layer_gain, device=device
    )
    tanh = TanhModule(in_keys=[pre_tanh_key], out_keys=[out_key], low=low, high=high)
    return TensorDictSequential(
        TensorDictModule(mlp, in_keys=list(in_keys), out_keys=[pre_tanh_key]), tanh.to(device)
    )


def make_vector_critic(
    num_objectives: int,
    observation_spec: Composite | None = None,
    action_spec: TensorSpec | None = None,
    *,
    in_features: int | None = None,
    in_keys: Sequence[NestedKey] = ("observation", "preference", "action"),
    num_cells: Sequence[int] = (256, 256, 256, 256),
    activation_class: type[nn.Module] = nn.ReLU,
    layer_norm: bool = True,
    out_key: NestedKey = "state_action_value",
    action_key: NestedKey = "action",
    device: torch.device | str | None = None,
) -> TensorDictModule:
    """Build a critic ``(state, preference, action) -> R^K`` with one value per objective.

    Under :class:`torch.autocast` the first and the last layer keep the precision of their weights, and
    so do values.

    The parameters are created at once (no lazy layers). Keys of the state dict:
    ``module.{index}.{weight, bias}``, the index counting linear layers, norms and activations.

    Args:
        num_objectives (int): the length ``K`` of the reward vector.
        observation_spec (Composite, optional): holds the inputs other than the action, which gives
            their sizes.
        action_spec (TensorSpec, optional): gives the size of the action, if that is an input.

    Keyword Args:
        in_features (int, optional): the summed size of all inputs, instead of specs.
        in_keys (Sequence[NestedKey]): the inputs, in the order of concatenation. They may hold keys
            that the actor does not see.
        num_cells (Sequence[int]): the sizes of the hidden layers.
        activation_class (type[nn.Module]): the activation of the hidden layers.
        layer_norm (bool): put a :class:`~torch.nn.LayerNorm` before every activation, which steadies
            off-policy critics.
        out_key (NestedKey): where the values are written.
        action_key (NestedKey): the input whose size ``action_spec`` gives.
        device (torch.device, optional): where the parameters live.

    Returns:
        A module that reads ``in_keys`` and writes ``out_key`` of shape ``[*B, K]``.

    Raises:
        ValueError: if ``num_objectives`` is not positive, or if the sizes of the inputs do not follow
            from the specs; at a call, for inputs of another size or precision.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from torchrl_morl.preferences import PreferenceSpace
        >>> from torchrl_morl.testing import VectorRewardMockEnv
        >>> from torchrl_morl.transforms import PreferenceSampler
        >>> space = PreferenceSpace(("left", "ahead", "right"))
        >>> env = TransformedEnv(VectorRewardMockEnv(3), PreferenceSampler(space))
        >>> critic = make_vector_critic(
        ...     space.num_objectives, env.observation_spec, env.action_spec, num_cells=(16,)
        ... )
        >>> critic(env.rollout(5))["state_action_value"].shape
        torch.Size([5, 3])

    """
    in_keys = key_list(in_keys)
    in_features = resolve_in_features(
        in_features, in_keys, observation_spec, action_spec, action_key
    )
    check_sizes(in_features, num_cells)
    check_device("device", device, holds_values=False)
    check_count("num_objectives", num_objectives, most=10_000)
    num_cells = list(num_cells)
    mlp = NamedInputsMLP(
        in_keys,
        in_features=in_features,
        out_features=num_objectives,
        num_cells=num_cells,
        activation_class=activation_class,
        norm_class=nn.LayerNorm if layer_norm else None,
        norm_kwargs=[{"normalized_shape": n} for n in num_cells] if layer_norm else None,
        device=device,
    )
    keep_precision(mlp, 0)
    keep_precision(mlp, -1)
    return TensorDictModule(mlp, in_keys=list(in_keys), out_keys=[out_key])


def saturated_fraction(
    action: Tensor,
    low: Tensor | float = -1.0,
    high: Tensor | float = 1.0,
    threshold: float = 0.99,
) -> Tensor:
    """Fraction of action entries that sit at the ends of their range.

    This is the health metric of a tanh actor: near 1 it drives at the bounds in every state, and its
    gradient is gone although all losses look fine. For a pre-tanh output pass its ``tanh()`` and
    leave the bounds out.

    Args:
        action (Tensor): actions of shape ``[*B, A]``.
        low (Tensor or float): the lower bound, broadcast against the action.
        high (Tensor or float): the upper bound, broadcast against the action.
        threshold (float): an entry is saturated if, scaled to ``[-1, 1]``, its absolute value is
            larger than this.

    Returns:
        A scalar tensor in ``[0, 1]``, detached.

    Example:
        >>> import torch
        >>> saturated_fraction(torch.tensor([[0.0, 0.9999], [-1.0, 0.5]]))
        tensor(0.5000)

    """
    scaled = 2 * (action.detach() - low) / (high - low) - 1
    return (scaled.abs() > threshold).to(action.dtype).mean()


def keep_precision(mlp: nn.Sequential, index: int) -> None:
    """Exchange a linear layer for one that autocast leaves alone, with the same parameters."""
    old = mlp[index]
    new = PreciseLinear(old.in_features, old.out_features, device="meta")
    # Its own parameters: none are drawn anew.
    new.weight, new.bias = old.weight, old.bias
    mlp[index] = new


def _action_bounds(action_spec: TensorSpec, key: NestedKey) -> tuple[Tensor, Tensor]:
    """Bounds ``[A]`` of an action spec whose batch dimensions are dropped."""
    if isinstance(action_spec, Composite):
        action_spec = action_spec[key]
    if not isinstance(action_spec, Bounded) or not action_spec.shape:
        raise ValueError(f"action_spec must be a Bounded spec of shape [*B, A], got {action_spec}.")
    low = (
        action_spec.space.low.flatten(0, -2)
        if action_spec.ndim > 1
        else action_spec.space.low[None]
    )
    high = action_spec.space.high.expand(action_spec.shape).reshape(low.shape)
    if not (low.isfinite().all() and high.isfinite().all()):
        bounds = low[0].tolist(), high[0].tolist()
        raise ValueError("the bounds of action_spec must be finite, got {} and {}.".format(*bounds))
    if (low != low[0]).any() or (high != high[0]).any():
        raise ValueError("action_spec has different bounds within its batch dimensions.")
    return low[0].clone(), high[0].clone()
