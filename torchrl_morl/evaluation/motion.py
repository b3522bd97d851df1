"""How a robot moves: standing, jerking and turning, as pure functions of padded trajectories.

Points are those of :mod:`torchrl_morl.evaluation.metrics`. Velocities are differences of
successive points: nothing that happens between two of them is seen.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchrl_morl.arguments import check_positive
from torchrl_morl.geometry import wrap_angle

from .arrays import as_flags, as_numbers, as_points, check_lengths
from .metrics import path_length

__all__ = ["cumulative_heading_change", "mean_jerk", "path_irregularity", "stalled_time"]


def stalled_time(position: Tensor, mask: Tensor, dt: float, threshold: float = 0.05) -> Tensor:
    r"""How long the robot stands, seconds.

    :math:`\sum_t \Delta t \, [\, |p_{t+1} - p_t| / \Delta t < v_{min} ]`, the stalled time of
    Francis et al. (https://arxiv.org/abs/2306.16740). Turning on the spot is standing.

    Args:
        position: ``[*B, T, 2]``, metres.
        mask: ``[*B, T]``.
        dt: control period, seconds.
        threshold: speed below which it stands, m/s.

    Returns:
        ``[*B]``.

    Examples:
        >>> import torch
        >>> position = torch.tensor([[0.0, 0.0], [0.0, 0.0], [0.0, 0.0], [0.1, 0.0]])
        >>> stalled_time(position, torch.ones(4).bool(), dt=0.2)
        tensor(0.4000)
    """
    check_positive("dt", dt)
    check_lengths(threshold=threshold)
    position = as_points("position", position)
    speed = position.diff(dim=-2).norm(dim=-1) / dt
    stands = (speed < threshold).to(speed.dtype).masked_fill(speed.isnan(), torch.nan)
    return dt * _total(stands, mask)


def mean_jerk(position: Tensor, mask: Tensor, dt: float) -> Tensor:
    r"""Mean magnitude of the jerk, m/s\ :sup:`3`.

    Mean over :math:`t` of the third difference of the positions over :math:`\Delta t^3` (the jerk
    of Francis et al., https://arxiv.org/abs/2306.16740). Third differences multiply errors of the
    positions by :math:`4.5 / \Delta t^3`: smooth a recording first, and compare only what was
    sampled at the same rate.

    Args:
        position: ``[*B, T, 2]``, metres.
        mask: ``[*B, T]``.
        dt: control period, seconds.

    Returns:
        ``[*B]``; NaN for less than four successive points.

    Examples:
        >>> import torch
        >>> time = torch.arange(6.0)
        >>> position = torch.stack((time**3, torch.zeros(6)), dim=-1)
        >>> mean_jerk(position, torch.ones(6).bool(), dt=1.0)
        tensor(6.)
    """
    check_positive("dt", dt)
    position, mask = as_points("position", position), as_flags(mask)
    jerk = position.diff(n=3, dim=-2).norm(dim=-1) / dt**3
    counts = mask[..., 3:] & mask[..., 2:-1] & mask[..., 1:-2] & mask[..., :-3]
    return jerk.masked_fill(~counts, 0.0).sum(-1) / counts.sum(-1)


def cumulative_heading_change(heading: Tensor, mask: Tensor) -> Tensor:
    r"""How much the robot turns altogether, radians.

    :math:`\sum_t |\mathrm{wrap}(\theta_{t+1} - \theta_t)|` (HuNavSim,
    https://arxiv.org/abs/2305.01303). Left and right do not cancel. The robot must turn by less
    than half a turn between two points.

    Args:
        heading: ``[*B, T]``, radians, wrapped or not.
        mask: ``[*B, T]``.

    Returns:
        ``[*B]``.

    Examples:
        >>> import torch
        >>> heading = torch.tensor([3.0, -3.0, 3.0])
        >>> cumulative_heading_change(heading, torch.ones(3).bool())
        tensor(0.5664)
    """
    heading = as_numbers(heading)
    return _total(wrap_angle(heading.diff(dim=-1)).abs(), mask)


def path_irregularity(position: Tensor, heading: Tensor, mask: Tensor, goal: Tensor) -> Tensor:
    r"""How much the robot turns without need, radians per metre of its path.

    :math:`\max(0, \mathrm{CHC} - |\beta_0|) / \ell`, with the
    :func:`cumulative_heading_change`, the bearing :math:`\beta_0` of the goal at the start, which
    it has to turn by, and the length :math:`\ell` of the path (Guzzi et al., Human-friendly robot
    navigation in dynamic environments, ICRA 2013). What it turns to get around an obstacle counts
    as well: compare episodes of the same scenes.

    Args:
        position: ``[*B, T, 2]``, metres.
        heading: ``[*B, T]``, radians.
        mask: ``[*B, T]``.
        goal: ``[*B, 2]``, metres.

    Returns:
        ``[*B]``; NaN for a robot that never moved.

    Examples:
        It turns left to its goal, and drives there.

        >>> import torch
        >>> position = torch.tensor([[0.0, 0.0], [0.0, 0.0], [0.0, 2.0]])
        >>> heading = torch.tensor([0.0, 1.5708, 1.5708])
        >>> goal = torch.tensor([0.0, 2.0])
        >>> path_irregularity(position, heading, torch.ones(3).bool(), goal).round(decimals=4)
        tensor(0.)
    """
    position, goal = as_points("position", position), as_points("goal", goal)
    heading = as_numbers(heading)
    way = goal - position[..., 0, :]
    bearing = wrap_angle(torch.atan2(way[..., 1], way[..., 0]) - heading[..., 0]).abs()
    needless = (cumulative_heading_change(heading, mask) - bearing).clamp_min(0.0)
    length = path_length(position, mask)
    return (needless / length).masked_fill(length == 0, torch.nan)


def _total(change: Tensor, mask: Tensor) -> Tensor:
    """Sum over the steps ``[*B, T-1]`` between two points that count; NaN without any point."""
    mask = as_flags(mask)
    both = mask[..., 1:] & mask[..., :-1]
    return change.masked_fill(~both, 0.0).sum(-1).masked_fill(~mask.any(-1), torch.nan)
