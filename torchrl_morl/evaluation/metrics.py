"""Metrics of padded trajectories: pure functions, no simulator.

A trajectory has ``T`` points including its start; ``mask`` marks those before and at its end.
Undefined is NaN. Definitions follow Francis et al. (https://arxiv.org/abs/2306.16740).
"""

from __future__ import annotations

import numpy as np
import scipy.stats
import torch
from torch import Tensor

__all__ = [
    "min_human_distance",
    "path_length",
    "steerability",
    "time_to_goal",
]


def min_human_distance(position: Tensor, human: Tensor, mask: Tensor) -> Tensor:
    """Smallest distance between the centres of robot and human, metres.

    Args:
        position: ``[*B, T, 2]``.
        human: ``[*B, T, 2]``.
        mask: ``[*B, T]``.

    Returns:
        ``[*B]``.

    Examples:
        >>> import torch
        >>> position = torch.tensor([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]])
        >>> human = torch.tensor([[2.0, 1.0]]).expand(3, 2)
        >>> min_human_distance(position, human, torch.tensor([True, True, False]))
        tensor(1.4142)
    """
    distance = (position - human).norm(dim=-1)
    nearest = distance.masked_fill(~mask, torch.inf).amin(-1)
    return nearest.masked_fill(~mask.any(-1), torch.nan)


def path_length(position: Tensor, mask: Tensor) -> Tensor:
    """Length of the path through the points, metres: ``[*B, T, 2]``, ``[*B, T]`` -> ``[*B]``."""
    step = (position[..., 1:, :] - position[..., :-1, :]).norm(dim=-1)
    length = step.masked_fill(~mask[..., 1:], 0.0).sum(-1)  # padding may be NaN
    return length.masked_fill(~mask.any(-1), torch.nan)


def time_to_goal(success: Tensor, mask: Tensor, dt: float) -> Tensor:
    """Time from the start to the goal, seconds; NaN unless the goal was reached.

    Args:
        success: ``[*B]``.
        mask: ``[*B, T]``, the start included.
        dt: control period, seconds.

    Returns:
        ``[*B]``.
    """
    time = (mask.sum(-1) - 1) * dt
    return time.masked_fill(~success, torch.nan)


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
