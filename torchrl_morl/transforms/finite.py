"""A guard against observations that are not numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs.transforms import Transform

from torchrl_morl.arguments import key_list
from torchrl_morl.representation import describe

__all__ = ["CheckFinite", "check_finite"]


def check_finite(data: TensorDictBase | Mapping[str, Tensor], keys: Sequence[NestedKey]) -> None:
    """Refuse NaN and infinity: a network turns one of them into an action that says nothing.

    Costs one sum per key. On an accelerator that waits for the device, and :func:`torch.compile`
    breaks the graph at it.

    Args:
        data: holds the keys.
        keys: what to check.

    Raises:
        ValueError: if a value is not finite. The message names the key, the index and the value.
        KeyError: if a key is missing.

    Example:
        >>> import torch
        >>> check_finite({"scan": torch.tensor([[0.5, float("nan")]])}, ["scan"])
        Traceback (most recent call last):
        ...
        ValueError: 'scan'[0, 1] = nan must be finite (1 of 2 values is not).

    """
    for key in keys:
        value = data[key]
        # NaN and infinity survive a sum, which takes a fortieth of the time. It may also overflow.
        if torch.isfinite(value.sum()):
            continue
        finite = torch.isfinite(value)
        if finite.all():
            continue
        wrong = (~finite).nonzero()
        position = tuple(wrong[0].tolist())
        index = f"[{', '.join(map(str, position))}]" if position else ""
        raise ValueError(
            f"{key!r}{index} = {value[position].item()} must be finite "
            f"({len(wrong)} of {value.numel()} values {'is' if len(wrong) == 1 else 'are'} not)."
        )


class CheckFinite(Transform):
    """Stop at the first observation that is NaN or infinite, and say which one it is.

    In an environment it checks what ``reset`` and ``step`` return; a reset leaves out what only
    steps have, such as rewards. Place it before transforms that mix keys, so that the message names
    the sensor. As a module or in a replay buffer it checks what
    passes through; name the keys of both time steps there, e.g. ``in_keys=["scan", ("next",
    "scan")]``. Nothing is changed. TorchRL's :class:`~torchrl.envs.FiniteTensorDictCheck` checks
    every entry, and does not say which of them failed.

    Args:
        in_keys (Sequence[NestedKey]): what to check, of any shape and dtype.

    Raises:
        ValueError: if a value is not finite, see :func:`check_finite`.
        KeyError: if a key is missing, in an environment at its first step.

    Example:
        >>> import torch
        >>> from torchrl.envs import TransformedEnv
        >>> from torchrl_morl.testing import VectorRewardMockEnv
        >>> env = TransformedEnv(VectorRewardMockEnv(2, batch_size=(4,)), CheckFinite())
        >>> env.rollout(3).shape
        torch.Size([4, 3])

    """

    def __init__(self, in_keys: Sequence[NestedKey] = ("observation",)) -> None:
        super().__init__(in_keys=key_list(in_keys), out_keys=key_list(in_keys))

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        check_finite(next_tensordict, self.in_keys)
        return next_tensordict

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        # TorchRL does not run `_call` at reset. There is no reward yet; of a key that is never there
        # the first step tells.
        present = tensordict_reset.keys(include_nested=True)
        check_finite(tensordict_reset, [key for key in self.in_keys if key in present])
        return tensordict_reset

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Check a tensordict.

        Args:
            tensordict (TensorDictBase): holds the ``in_keys``.

        Returns:
            The same tensordict.

        """
        return self._call(tensordict)

    def __repr__(self) -> str:
        return describe(self, in_keys=self.in_keys)
