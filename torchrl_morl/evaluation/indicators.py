"""Indicators of a policy over its preferences."""

from __future__ import annotations

import numpy as np
import scipy.stats
from torch import Tensor

__all__ = ["steerability"]


def steerability(preference: Tensor, metric: Tensor) -> float:
    """Spearman rank correlation between the entry of a preference and the metric it steers.

    Args:
        preference: ``[P]``, values of one entry.
        metric: ``[P]``, the metric's mean at each of them.

    Returns:
        Rho in [-1, 1]; NaN if either is constant or holds NaN.

    Examples:
        >>> import torch
        >>> round(steerability(torch.tensor([0.0, 0.5, 1.0]), torch.tensor([0.4, 0.9, 1.3])), 3)
        1.0
    """
    first, second = np.asarray(preference, dtype=float), np.asarray(metric, dtype=float)
    if np.isnan(first).any() or np.isnan(second).any():
        return float("nan")
    if np.ptp(first) == 0 or np.ptp(second) == 0:
        return float("nan")
    return float(scipy.stats.spearmanr(first, second).statistic)
