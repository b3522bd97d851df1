"""Metrics of the way to the goal: pure functions of padded trajectories, no simulator.

A trajectory has ``T`` points including its start; ``mask`` marks those before and at its end, and
what lies behind it may be anything, NaN included. NaN before it makes the result NaN, and so does
whatever leaves a value undefined. NumPy arrays and nested lists do as well as tensors; what comes
back is a tensor. Definitions follow Francis et al.
(https://arxiv.org/abs/2306.16740); ``docs/metrics.md`` lists them all.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchrl_morl.arguments import check_positive

from .arrays import as_flags, as_numbers, as_points

__all__ = ["path_length", "spl", "stl", "time_to_goal"]


def path_length(position: Tensor, mask: Tensor) -> Tensor:
    r"""Length of the path through the points, :math:`\sum_t |p_{t+1} - p_t|`, metres.

    Args:
        position: ``[*B, T, 2]``, metres.
        mask: ``[*B, T]``.

    Returns:
        ``[*B]``; NaN for a path without points.

    Examples:
        >>> import torch
        >>> position = torch.tensor([[0.0, 0.0], [3.0, 4.0], [3.0, 5.0]])
        >>> path_length(position, torch.tensor([True, True, True]))
        tensor(6.)
    """
    position, mask = as_points("position", position), as_flags(mask)
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

    Examples:
        >>> import torch
        >>> success = torch.tensor([True, False])
        >>> mask = torch.tensor([[True, True, True, False], [True, True, True, True]])
        >>> time_to_goal(success, mask, dt=0.5)
        tensor([1., nan])
    """
    check_positive("dt", dt)
    success, mask = as_flags(success), as_flags(mask)
    time = (mask.sum(-1) - 1) * dt
    return time.masked_fill(~(success & mask.any(-1)), torch.nan)


def spl(success: Tensor, position: Tensor, mask: Tensor, shortest: Tensor) -> Tensor:
    r"""Success weighted by path length, from 0 to 1.

    :math:`S \, \ell^* / \max(\ell, \ell^*)` with the length :math:`\ell` of the path (Anderson et
    al., https://arxiv.org/abs/1807.06757). A failure counts as 0. It favours waiting over going
    around: give :func:`stl` beside it.

    Args:
        success: ``[*B]``.
        position: ``[*B, T, 2]``, metres.
        mask: ``[*B, T]``.
        shortest: ``[*B]``, metres: the shortest way from the start to where the goal counts as
            reached, its radius taken off, that touches no obstacle. The straight line is one only
            where nothing stands on it. NaN where there is none.

    Returns:
        ``[*B]``; NaN where ``shortest`` is, for failures too: leaving out successes alone would
        bias the mean.

    Raises:
        ValueError: if ``shortest`` is negative.

    Examples:
        >>> import torch
        >>> corner = torch.tensor([[0.0, 0.0], [3.0, 0.0], [3.0, 4.0]])
        >>> spl(torch.tensor(True), corner, torch.ones(3).bool(), shortest=torch.tensor(5.0))
        tensor(0.7143)
    """
    return _weighted(success, path_length(position, mask), shortest, "shortest")


def stl(success: Tensor, mask: Tensor, dt: float, reference: Tensor) -> Tensor:
    r"""Success weighted by time length, from 0 to 1.

    :math:`S \, T^* / \max(T, T^*)` with the time :math:`T` from the start to the end, as in the
    iGibson challenge 2021 (http://svl.stanford.edu/igibson/challenge2021.html), whose reference
    is an ORCA agent in the same scene. A failure counts as 0.

    Args:
        success: ``[*B]``.
        mask: ``[*B, T]``.
        dt: control period, seconds.
        reference: ``[*B]``, seconds: how long the reference took, for instance the shortest way
            at full speed. NaN where it failed, which says nothing about the robot.

    Returns:
        ``[*B]``; NaN where ``reference`` is, for failures too.

    Raises:
        ValueError: if ``reference`` is negative.

    Examples:
        >>> import torch
        >>> mask = torch.ones(2, 11, dtype=torch.bool)
        >>> stl(torch.tensor([True, False]), mask, dt=0.5, reference=torch.tensor([4.0, 4.0]))
        tensor([0.8000, 0.0000])
    """
    check_positive("dt", dt)
    mask = as_flags(mask)
    time = (mask.sum(-1) - 1) * dt
    return _weighted(success, time.masked_fill(~mask.any(-1), torch.nan), reference, "reference")


def _weighted(success: Tensor, actual: Tensor, best: Tensor, name: str) -> Tensor:
    success, best = as_flags(success), as_numbers(best)
    negative = best[best < 0]
    if negative.numel():
        raise ValueError(
            f"{name} must not be negative, got {negative[0].item()}: clamp it at 0 for an episode "
            "that starts in its goal."
        )
    ratio = (best / torch.maximum(actual, best)).masked_fill(~success, 0.0)
    return ratio.masked_fill(actual.isnan() | best.isnan(), torch.nan)
