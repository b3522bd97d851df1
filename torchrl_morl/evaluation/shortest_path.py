"""The shortest way of a round robot past boxes and a standing human, to compare driven ones with."""

from __future__ import annotations

import math

import numpy as np
import scipy.sparse.csgraph
import torch
from torch import Tensor

from torchrl_morl.geometry import rotate, segment_box_distance

__all__ = ["shortest_path_length"]

# Points per quarter of a circle: with 4 a path around half a circle is 0.6 % too long.
_POINTS = 4
_TOLERANCE = 1e-6


def shortest_path_length(
    start: Tensor,
    goal: Tensor,
    boxes: Tensor,
    *,
    radius: float,
    goal_radius: float = 0.0,
    human: Tensor | None = None,
    human_radius: float = 0.0,
) -> Tensor:
    """Length of the shortest way on which the robot's body touches nothing, metres.

    Obstacles grown by the robot's radius become points for a visibility graph (Lozano-Perez and
    Wesley, https://doi.org/10.1145/359156.359164), their round parts outlined by tangents. The result
    is therefore a way that can be driven, longer than the shortest one by millimetres.

    Args:
        start: ``[N, 2]`` or more entries, metres.
        goal: ``[N, 2]``.
        boxes: ``[N, M, 5]``: x, y, yaw, half length, half width.

    Keyword Args:
        radius: of the robot.
        goal_radius: distance from the goal at which it counts as reached; taken off the length.
        human: ``[N, 2]`` or more entries, where one stands in the way.
        human_radius: of the human.

    Returns:
        ``[N]``, float64; NaN where there is no way.

    Raises:
        ValueError: for a radius that is not positive.

    Examples:
        A wall across the way, 2 m wide and thin: the robot bends around its end.

        >>> import torch
        >>> wall = torch.tensor([[[2.0, 0.0, 0.0, 0.001, 1.0]]])
        >>> start, goal = torch.tensor([[0.0, 0.0]]), torch.tensor([[4.0, 0.0]])
        >>> length = shortest_path_length(start, goal, wall, radius=0.01)
        >>> round(length.item(), 2), round(2 * (2**2 + 1**2) ** 0.5, 2)
        (4.48, 4.47)
    """
    if not radius > 0:
        raise ValueError(f"radius must be positive, got {radius}.")
    start, goal, boxes = (tensor.double() for tensor in (start[..., :2], goal[..., :2], boxes))
    grown = torch.full(boxes.shape[:-1], float(radius), dtype=torch.float64)
    if human is not None:
        # A box without extent, grown by more: a circle.
        point = torch.zeros(len(start), 1, 5, dtype=torch.float64)
        point[:, 0, :2] = human[..., :2]
        boxes = torch.cat((boxes, point), dim=1)
        grown = torch.cat((grown, torch.full((len(start), 1), radius + human_radius).double()), 1)
    lengths = [_shortest(*scene) for scene in zip(start, goal, boxes, grown)]
    return (torch.tensor(lengths, dtype=torch.float64) - goal_radius).clamp_min(0.0)


def _shortest(start: Tensor, goal: Tensor, boxes: Tensor, grown: Tensor) -> float:
    """Through the visibility graph of one scene; boxes ``[M, 5]``, grown by ``[M]``."""
    nodes = torch.cat((start[None], goal[None], _outlines(boxes, grown)))
    first, second = torch.triu_indices(len(nodes), len(nodes), offset=1)
    ends = nodes[first, None], nodes[second, None]
    free = (segment_box_distance(*ends, boxes) >= grown - _TOLERANCE).all(-1)
    length = (nodes[first] - nodes[second]).norm(dim=-1)
    graph = np.zeros((len(nodes), len(nodes)))
    graph[first[free], second[free]] = length[free].clamp_min(1e-12)  # zero is no edge
    distance = scipy.sparse.csgraph.dijkstra(graph, directed=False, indices=0)[1]
    return float(distance) if math.isfinite(distance) else math.nan


def _outlines(boxes: Tensor, grown: Tensor) -> Tensor:
    """Corners of polygons around the grown boxes, ``[M * 4 * _POINTS, 2]``.

    Their sides are those of the boxes, moved outwards, and tangents to the arcs between.
    """
    step = math.pi / 2 / _POINTS
    angle = (torch.arange(4 * _POINTS, dtype=torch.float64) + 0.5) * step
    away = torch.stack((angle.cos(), angle.sin()), dim=-1)
    offset = away.sign() * boxes[:, None, 3:] + away * (grown / math.cos(step / 2))[:, None, None]
    return (boxes[:, None, :2] + rotate(offset, boxes[:, 2:3].expand(offset.shape[:-1]))).flatten(
        0, 1
    )
