"""Actions that no robot can take: what is wrong with them, in one line."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


def refuse_shape(action: Tensor | None, shape: Sequence[int]) -> None:
    """Raise ``ValueError`` for an action that is missing, or not of the action spec's shape."""
    got = "there is none" if action is None else f"got {list(action.shape)}"
    raise ValueError(f"The action must have shape {list(shape)}, {got}.")


def refuse_non_finite(action: Tensor) -> None:
    """Raise ``ValueError`` for actions ``[N, ...]`` of which one is not finite."""
    finite = torch.isfinite(action).flatten(1).all(-1)
    if not finite.all():
        row = int((~finite).nonzero()[0])
        raise ValueError(
            f"The action of environment {row} is {action[row].tolist()}: actions must be "
            "finite. Check the policy's input and weights for NaN."
        )
