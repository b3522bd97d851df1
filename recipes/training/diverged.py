"""A training whose numbers are none any more: it ends there, and says which."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor


def refuse_diverged(values: Mapping[str, Tensor], when: str, hint: str) -> None:
    """Refuse losses and norms of gradients that are NaN or infinite: whatever is learned from them is lost.

    Waits once for an accelerator.

    Args:
        values: what an update has measured, by name, of any shape; those that are neither a loss nor a
            norm may be what they are.
        when: "before step 960".
        hint: what to change, "optim.lr=1e+30: lower it".

    Raises:
        ValueError: in one line, with the first of them.

    Examples:
        >>> refuse_diverged({"loss_actor": torch.tensor(1.0)}, "before step 1", "")
        >>> refuse_diverged(
        ...     {"loss_actor": torch.tensor(torch.nan)}, "before step 1", "lower optim.lr"
        ... )
        Traceback (most recent call last):
        ...
        ValueError: loss_actor became nan before step 1: lower optim.lr.
    """
    names = [name for name in values if name.startswith(("loss", "grad_norm"))]
    if not names:
        return
    means = torch.stack([values[name].detach().double().mean() for name in names])
    wrong = (~means.isfinite()).nonzero()
    if len(wrong):
        first = int(wrong[0])
        raise ValueError(f"{names[first]} became {means[first].item():g} {when}: {hint}.")
