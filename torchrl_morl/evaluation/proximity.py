"""How close a robot comes to people and obstacles: pure functions of padded trajectories.

Points are those of :mod:`torchrl_morl.evaluation.metrics`. Where a recording misses the human,
mask the point out: none of these functions but the time to collision looks at neighbours.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchrl_morl.arguments import check_positive
from torchrl_morl.geometry import point_box_distance

from .arrays import as_flags, as_points, check_lengths

__all__ = [
    "human_exposure",
    "min_clearance",
    "min_human_distance",
    "min_surface_distance",
    "min_time_to_collision",
    "personal_space_compliance",
    "space_violations",
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
    position, human = as_points("position", position), as_points("human", human)
    distance = (position - human).norm(dim=-1)
    return _smallest(distance, mask)


def min_surface_distance(
    position: Tensor, human: Tensor, mask: Tensor, radius: float, human_radius: float
) -> Tensor:
    r"""Smallest distance between the surfaces of robot and human, metres; 0 if they touch.

    :math:`\max(0, \min_t |p_t - h_t| - r - R)`, as HuNavSim's minimum distance to people
    (https://arxiv.org/abs/2305.01303); :func:`min_human_distance` is the one between centres.

    Args:
        position: ``[*B, T, 2]``, metres.
        human: ``[*B, T, 2]``, metres.
        mask: ``[*B, T]``.
        radius: of the robot, metres.
        human_radius: metres.

    Returns:
        ``[*B]``.

    Examples:
        >>> import torch
        >>> position = torch.tensor([[0.0, 0.0], [1.0, 0.0]])
        >>> human = torch.tensor([[2.0, 0.0]]).expand(2, 2)
        >>> min_surface_distance(position, human, torch.ones(2).bool(), 0.2, 0.3)
        tensor(0.5000)
    """
    check_lengths(radius=radius, human_radius=human_radius)
    nearest = min_human_distance(position, human, mask)
    return (nearest - radius - human_radius).clamp_min(0.0)


def human_exposure(
    position: Tensor, human: Tensor, mask: Tensor, dt: float, threshold: float = 2.0
) -> Tensor:
    r"""How close a robot comes to a human and for how long, square metres times seconds.

    :math:`\sum_t \max(0, d - |p_t - h_t|)^2 \Delta t` with the threshold :math:`d`: what the distance
    objective of the paper (equation 3, https://arxiv.org/abs/2404.04857) charges for, up to its constant.
    :func:`min_human_distance` counts the nearest moment alone: who cuts a corner may come nearer and
    yet be exposed less.

    Args:
        position: ``[*B, T, 2]``, metres.
        human: ``[*B, T, 2]``, metres.
        mask: ``[*B, T]``.
        dt: time between points, s.
        threshold: distance between the centres from which on nothing counts, metres.

    Returns:
        ``[*B]``; NaN without points.

    Examples:
        >>> import torch
        >>> position = torch.tensor([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]])
        >>> human = torch.tensor([[2.0, 0.0]]).expand(3, 2)
        >>> human_exposure(position, human, torch.ones(3).bool(), dt=0.5)
        tensor(2.5000)
    """
    check_positive("dt", dt)
    check_lengths(threshold=threshold)
    position, human = as_points("position", position), as_points("human", human)
    mask = as_flags(mask)
    closeness = (threshold - (position - human).norm(dim=-1)).clamp_min(0.0).square()
    exposure = closeness.masked_fill(~mask, 0.0).sum(-1) * dt
    return exposure.masked_fill(~mask.any(-1), torch.nan)


def personal_space_compliance(
    position: Tensor, human: Tensor, mask: Tensor, threshold: float = 0.5
) -> Tensor:
    """Share of the time that the robot leaves a human their personal space, from 0 to 1.

    Share of the points with at least ``threshold`` between the centres (iGibson challenge 2021,
    http://svl.stanford.edu/igibson/challenge2021.html, but over the time driven instead of the
    longest episode allowed). 1 is compliance: other code names the share of violations so.

    Args:
        position: ``[*B, T, 2]``, metres.
        human: ``[*B, T, 2]``, metres.
        mask: ``[*B, T]``.
        threshold: metres; add both radii for a distance between surfaces.

    Returns:
        ``[*B]``.

    Examples:
        >>> import torch
        >>> position = torch.tensor([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [3.0, 0.0]])
        >>> human = torch.tensor([[2.0, 0.4]]).expand(4, 2)
        >>> personal_space_compliance(position, human, torch.ones(4).bool())
        tensor(0.7500)
    """
    check_lengths(threshold=threshold)
    position, human = as_points("position", position), as_points("human", human)
    mask = as_flags(mask)
    distance = (position - human).norm(dim=-1)
    kept = (distance >= threshold).to(distance.dtype).masked_fill(distance.isnan(), torch.nan)
    return kept.masked_fill(~mask, 0.0).sum(-1) / mask.sum(-1)


def space_violations(
    position: Tensor, human: Tensor, mask: Tensor, threshold: float = 0.5
) -> Tensor:
    """How many times the robot intrudes on a human's personal space.

    Counts runs of points with less than ``threshold`` between the centres: a robot that comes,
    leaves and comes again intrudes twice, however long it stays, which is what
    :func:`personal_space_compliance` measures. An episode that begins inside begins with one.

    Args:
        position: ``[*B, T, 2]``, metres.
        human: ``[*B, T, 2]``, metres.
        mask: ``[*B, T]``.
        threshold: metres; add both radii for a distance between surfaces.

    Returns:
        ``[*B]``, whole numbers.

    Examples:
        >>> import torch
        >>> position = torch.tensor([[2.0, 0.0], [1.0, 0.0], [2.0, 0.0], [3.0, 0.0]])
        >>> human = torch.tensor([[2.0, 0.4]]).expand(4, 2)
        >>> space_violations(position, human, torch.ones(4).bool())
        tensor(2.)
    """
    check_lengths(threshold=threshold)
    position, human = as_points("position", position), as_points("human", human)
    mask = as_flags(mask)
    distance = (position - human).norm(dim=-1)
    inside = (distance < threshold) & mask
    before = torch.cat((torch.zeros_like(inside[..., :1]), inside[..., :-1]), dim=-1)
    count = (inside & ~before).sum(-1).to(distance.dtype)
    undefined = (distance.isnan() & mask).any(-1) | ~mask.any(-1)
    return count.masked_fill(undefined, torch.nan)


def min_time_to_collision(
    position: Tensor, human: Tensor, mask: Tensor, dt: float, radius: float, human_radius: float
) -> Tensor:
    r"""Smallest time to collision, seconds: 0 if they touch, infinite if never on course for it.

    At every point, the smallest :math:`\tau \ge 0` with :math:`|d + v \tau| = r + R`, where
    :math:`d` leads from the robot to the human and :math:`v`, its rate of change, is that over the
    last step: both go on as they have just moved. Radii count, and a pass at a distance is no
    collision (Francis et al., https://arxiv.org/abs/2306.16740, minimum time to collision).

    Means over episodes are infinite as soon as one is: report a median, or the share below a
    threshold.

    Args:
        position: ``[*B, T, 2]``, metres.
        human: ``[*B, T, 2]``, metres.
        mask: ``[*B, T]``.
        dt: control period, seconds.
        radius: of the robot, metres.
        human_radius: metres.

    Returns:
        ``[*B]``; NaN without two successive points, unless the robot touches the human.

    Examples:
        A robot at 1 m/s meets a human who stands 3 m ahead, and stops after one second.

        >>> import torch
        >>> position = torch.tensor([[0.0, 0.0], [0.5, 0.0], [1.0, 0.0], [1.0, 0.0]])
        >>> human = torch.tensor([[3.0, 0.0]]).expand(4, 2)
        >>> min_time_to_collision(position, human, torch.ones(4).bool(), 0.5, 0.2, 0.3)
        tensor(1.5000)
    """
    check_positive("dt", dt)
    check_lengths(radius=radius, human_radius=human_radius)
    position, human = as_points("position", position), as_points("human", human)
    mask = as_flags(mask)
    offset = human - position
    gap = offset.square().sum(-1) - (radius + human_radius) ** 2
    velocity = offset.diff(dim=-2) / dt
    # Roots of |v|^2 tau^2 - 2 approach tau + gap, the nearer one without a difference of equals.
    approach = -(offset[..., 1:, :] * velocity).sum(-1)
    root = approach.square() - velocity.square().sum(-1) * gap[..., 1:]
    time = gap[..., 1:] / (approach + root.clamp_min(0.0).sqrt())
    moved = mask[..., 1:] & mask[..., :-1]
    time = time.masked_fill(~((approach > 0) & (root >= 0) & moved), torch.inf)
    # At the start nobody has moved yet.
    time = torch.cat((torch.full_like(gap[..., :1], torch.inf), time), dim=-1)
    time = time.masked_fill(gap <= 0, 0.0).masked_fill(gap.isnan(), torch.nan)
    nearest = _smallest(time, mask)
    return nearest.masked_fill(~moved.any(-1) & nearest.isinf(), torch.nan)


def min_clearance(position: Tensor, boxes: Tensor, mask: Tensor, radius: float) -> Tensor:
    """Smallest distance between the robot's surface and boxes, metres; 0 if they touch.

    Minimum clearing distance of Francis et al. (https://arxiv.org/abs/2306.16740), with the exact
    distance to the rectangles.

    Args:
        position: ``[*B, T, 2]``, metres.
        boxes: ``[*B, N, 5]`` (x, y, yaw, half length, half width), broadcastable.
        mask: ``[*B, T]``.
        radius: of the robot, metres.

    Returns:
        ``[*B]``; NaN without boxes.

    Examples:
        >>> import torch
        >>> position = torch.tensor([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]])
        >>> boxes = torch.tensor([[1.0, 1.0, 0.0, 0.5, 0.25]])
        >>> min_clearance(position, boxes, torch.ones(3).bool(), radius=0.2)
        tensor(0.5500)
    """
    check_lengths(radius=radius)
    position, boxes = as_points("position", position), as_points("boxes", boxes, 5)
    if not boxes.shape[-2]:
        return torch.full_like(position[..., 0, 0], torch.nan)
    distance = point_box_distance(position.unsqueeze(-2), boxes.unsqueeze(-3)).amin(-1)
    return (_smallest(distance, mask) - radius).clamp_min(0.0)


def _smallest(value: Tensor, mask: Tensor) -> Tensor:
    """Minimum over the points ``[*B, T]`` that count; NaN if there is none."""
    mask = as_flags(mask)
    smallest = value.masked_fill(~mask, torch.inf).amin(-1)
    return smallest.masked_fill(~mask.any(-1), torch.nan)
