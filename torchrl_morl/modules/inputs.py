"""The inputs of a network: their size, from specs, and what is wrong with a batch of them."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import torch
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.data import Composite, TensorSpec
from torchrl.modules import MLP

from torchrl_morl.preferences import PreferenceSpace

__all__ = ["NamedInputsMLP", "resolve_in_features"]


class NamedInputsMLP(MLP):
    """A :class:`torchrl.modules.MLP` over the concatenation of inputs that it knows by name.

    It refuses inputs of another size or precision than that of its weights, and says which.
    :class:`torch.autocast` converts, so that precision does not matter there. Keys of the state
    dict are those of the parent.

    Args:
        in_keys (Sequence[NestedKey]): the inputs, in the order of concatenation.
        **kwargs: see :class:`torchrl.modules.MLP`.

    Raises:
        ValueError: at a call, for inputs that do not fit.

    Example:
        >>> import torch
        >>> mlp = NamedInputsMLP(["observation"], in_features=4, out_features=1, num_cells=[8])
        >>> mlp(torch.zeros(1, 4, dtype=torch.float64))
        Traceback (most recent call last):
        ...
        ValueError: 'observation' is float64, the network float32: append DoubleToFloat() to the \
environment, or build the network in float64.

    """

    def __init__(self, in_keys: Sequence[NestedKey], **kwargs) -> None:
        super().__init__(**kwargs)
        self.in_keys = [unravel_key(key) for key in in_keys]
        self._preference: tuple[int, PreferenceSpace] | None = None

    def check_preferences(self, key: NestedKey, preference_space: PreferenceSpace | None) -> None:
        """From now on refuse an input that is no preference, in eager mode.

        Looking at the values waits for an accelerator, and nothing that is traced can do it: neither
        :func:`torch.compile` nor :func:`torch.export` nor :func:`torch.vmap` does.

        Args:
            key (NestedKey): one of the inputs.
            preference_space (PreferenceSpace, optional): what it must be a point of; ``None`` for no
                check, as in a network that nobody has called this of.

        Raises:
            ValueError: if there is no such input; at a call, for a preference off the simplex.

        """
        key = unravel_key(key)
        if key not in self.in_keys:
            raise ValueError(f"{key!r} is no input: this network reads {self.in_keys}.")
        if preference_space is None:
            self._preference = None
        else:
            self._preference = self.in_keys.index(key), preference_space

    def forward(self, *inputs: Tensor) -> Tensor:
        """Concatenate the inputs ``[*B, F_i]`` and run the network."""
        self._check(inputs)
        if self._preference is not None and not torch.compiler.is_compiling():
            index, preference_space = self._preference
            # Whoever gives them concatenated has no preference to be looked at.
            if len(inputs) == len(self.in_keys) and _has_values(inputs[index]):
                preference_space.validate(inputs[index])
        return super().forward(*inputs)

    def _check(self, inputs: Sequence[Tensor]) -> None:
        weight = self[0].weight
        size = sum(value.shape[-1] for value in inputs)
        if size != weight.shape[-1]:
            sizes = {key: value.shape[-1] for key, value in zip(self.in_keys, inputs)}
            raise ValueError(
                f"the network takes {weight.shape[-1]} entries, the inputs have {size}: {sizes}. "
                "Build it from the specs of this environment, or give the environment's observation "
                "to one of its own."
            )
        # As concatenation does: a preference of single precision joins an observation of double.
        dtype = functools.reduce(torch.promote_types, (value.dtype for value in inputs))
        if dtype == weight.dtype or torch.is_autocast_enabled(weight.device.type):
            return
        other = [
            (key, value.dtype)
            for key, value in zip(self.in_keys, inputs)
            if value.dtype != weight.dtype
        ]
        key, dtype = other[0]
        advice = (
            "append DoubleToFloat() to the environment, or build the network in float64"
            if dtype == torch.float64
            else "convert one of them"
        )
        raise ValueError(f"{key!r} is {_name(dtype)}, the network {_name(weight.dtype)}: {advice}.")


def resolve_in_features(
    in_features: int | None,
    in_keys: Sequence[NestedKey],
    observation_spec: Composite | None,
    action_spec: TensorSpec | None = None,
    action_key: NestedKey = "action",
) -> int:
    """The summed size of all inputs: as given, or from the specs of an environment.

    Args:
        in_features (int, optional): the size, where there are no specs.
        in_keys (Sequence[NestedKey]): the inputs.
        observation_spec (Composite, optional): holds all inputs but the action.
        action_spec (TensorSpec, optional): the action's, or a composite that holds it.
        action_key (NestedKey): which of the inputs is the action.

    Returns:
        The sum of the last dimensions.

    Raises:
        ValueError: for both a size and a spec or for neither of them, for an input that the specs do
            not have, or one without a dimension of features.
    """
    if (in_features is None) == (observation_spec is None and action_spec is None):
        raise ValueError(
            f"give the specs of the environment or in_features={in_features}: one of the two."
        )
    if in_features is not None:
        return in_features
    known: dict[NestedKey, int | None] = {}
    for spec in (observation_spec, action_spec):
        if isinstance(spec, Composite):
            for key in spec.keys(True, True):
                known[unravel_key(key)] = _last_size(spec[key], spec.ndim)
        elif spec is not None:
            known[unravel_key(action_key)] = _last_size(spec, 0)
    total = 0
    for key in map(unravel_key, in_keys):
        if key not in known:
            raise ValueError(
                f"the input {key!r} is not in the specs, which have {list(known)}. A preference is "
                "there behind a PreferenceSampler."
            )
        if known[key] is None:
            raise ValueError(
                f"the input {key!r} has no dimension of features behind those of the batch: append "
                "an UnsqueezeTransform to the environment."
            )
        total += known[key]
    return total


def _last_size(spec: TensorSpec, batch_dims: int) -> int | None:
    return spec.shape[-1] if spec.ndim > batch_dims else None


def _has_values(value: Tensor) -> bool:
    """Not so where something traces: of a fake tensor, or under a functional transform."""
    if type(value) is not Tensor or torch.jit.is_tracing():
        return False
    if torch._C._functorch.is_functorch_wrapped_tensor(value):
        return False
    return not (value.is_cuda and torch.cuda.is_current_stream_capturing())


def _name(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")
