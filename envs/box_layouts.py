"""Boxes in scenes: scattered ones, walls, pockets, corridors and doorways.

Each function returns one that draws boxes ``[n, B, 5]`` (x, y, yaw, half length, half width; metres,
radians) for robots that start at the origin and whose goals lie on the positive x axis. Boxes that a
scene lacks lie far away. What overlaps the start, the goal or a person is thrown away by
:class:`envs.layouts.Layout`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import torch
from torch import Tensor

from .people import FAR, Bound, Draw, uniform

Boxes = Callable[[Tensor, float, torch.Generator], Tensor]
"""``boxes(way [n], robot_radius, generator)`` draws ``[n, B, 5]`` for goals ``way`` metres away."""

_WALL = 0.1
"""Half the thickness of walls, metres."""


@dataclasses.dataclass(frozen=True)
class BoxLayout:
    """Boxes that are drawn together.

    Args:
        count: how many there are at most: of each scene's array.
        draw: see :data:`Boxes`.
    """

    count: int
    draw: Boxes


def missing_boxes(n: int, count: int) -> Tensor:
    """Boxes that are not there, ``[n, count, 5]``: far away, and apart from each other."""
    boxes = torch.full((n, count, 5), 0.1, dtype=torch.float64)
    boxes[..., 0], boxes[..., 2] = FAR, 0.0
    boxes[..., 1] = FAR + 10.0 * torch.arange(count, dtype=torch.float64)
    return boxes


def _no_boxes(way: Tensor, robot_radius: float, generator: torch.Generator) -> Tensor:
    return missing_boxes(len(way), 0)


NO_BOXES = BoxLayout(0, _no_boxes)


def scattered(
    count: tuple[int, int], half_length: Draw = (0.15, 0.6), half_width: Draw = (0.15, 0.4)
) -> BoxLayout:
    """A number of boxes from a range, anywhere beside and on the way, gaps of any width between them."""
    return BoxLayout(count[1], Bound(_scattered, (count, half_length, half_width)))


def _scattered(
    way: Tensor,
    robot_radius: float,
    generator: torch.Generator,
    count: tuple[int, int],
    half_length: Draw,
    half_width: Draw,
) -> Tensor:
    low, most = count
    n = len(way)
    shape = (n, most)
    boxes = torch.stack(
        (
            0.5 + uniform(shape, (0.0, 1.0), generator) * (way[:, None] - 1.0),
            uniform(shape, (-2.5, 2.5), generator),
            uniform(shape, (-math.pi, math.pi), generator),
            uniform(shape, half_length, generator),
            uniform(shape, half_width, generator),
        ),
        dim=-1,
    )
    number = torch.randint(low, most + 1, (n, 1), generator=generator)
    there = torch.arange(most) < number
    return torch.where(there[..., None], boxes, missing_boxes(n, most))


def narrow_gaps() -> BoxLayout:
    """Two pairs of boxes across the way, whose gaps are too narrow: 30 to 95 % of the robot's width."""
    return BoxLayout(4, _narrow_gaps)


def _narrow_gaps(way: Tensor, robot_radius: float, generator: torch.Generator) -> Tensor:
    n = len(way)
    pairs = []
    for share in ((0.2, 0.45), (0.55, 0.8)):
        x = way * uniform((n,), share, generator)
        y = uniform((n,), (-0.5, 0.5), generator)
        gap = 2 * robot_radius * uniform((n,), (0.3, 0.95), generator)
        half = uniform((2, n), (0.2, 0.6), generator)
        width = uniform((2, n), (0.1, 0.3), generator)
        for side, one in ((1.0, 0), (-1.0, 1)):
            centre = y + side * (gap / 2 + half[one])
            pairs.append(_wall(x, centre, half[one], width[one]))
    return torch.stack(pairs, dim=1)


def wall_across(half_length: Draw = (1.0, 1.6)) -> BoxLayout:
    """One wall across the way."""
    return BoxLayout(1, Bound(_wall_across, (half_length,)))


def _wall_across(
    way: Tensor, robot_radius: float, generator: torch.Generator, half_length: Draw
) -> Tensor:
    n = len(way)
    x = way * uniform((n,), (0.3, 0.7), generator)
    y = uniform((n,), (-0.8, 0.8), generator)
    wall = _wall(x, y, uniform((n,), half_length, generator))
    wall[:, 2] = uniform((n,), (-0.4, 0.4), generator)
    return wall[:, None]


def pocket(width: Draw = (1.2, 2.4), depth: Draw = (0.8, 1.5)) -> BoxLayout:
    """Three walls that open towards the start: who drives straight at the goal is caught."""
    return BoxLayout(3, Bound(_pocket, (width, depth)))


def _pocket(
    way: Tensor, robot_radius: float, generator: torch.Generator, width: Draw, depth: Draw
) -> Tensor:
    n = len(way)
    x = way * uniform((n,), (0.45, 0.7), generator)
    y = uniform((n,), (-0.4, 0.4), generator)
    half, deep = (uniform((n,), ends, generator) / 2 for ends in (width, depth))
    back = _wall(x, y, half + 2 * _WALL)
    sides = []
    for side in (1.0, -1.0):
        arm = torch.stack(
            (
                x - _WALL - deep,
                y + side * (half + _WALL),
                torch.zeros_like(x),
                deep,
                torch.full_like(x, _WALL),
            ),
            dim=-1,
        )
        sides.append(arm)
    return torch.stack((back, *sides), dim=1)


def corridor(width: float) -> BoxLayout:
    """Two walls along the whole way, that many metres apart."""
    return BoxLayout(2, Bound(_corridor, (width,)))


def _corridor(way: Tensor, robot_radius: float, generator: torch.Generator, width: float) -> Tensor:
    walls = torch.zeros(len(way), 2, 5, dtype=torch.float64)
    walls[..., 0] = way[:, None] / 2
    walls[..., 1] = torch.tensor([1.0, -1.0]) * (width / 2 + _WALL)
    walls[..., 3], walls[..., 4] = way[:, None] / 2 + 5.0, _WALL
    return walls


def doorway(beyond_robot: Draw = (0.3, 0.6)) -> BoxLayout:
    """A door in a wall across the way, that much wider than the robot."""
    return BoxLayout(2, Bound(_doorway, (beyond_robot,)))


def _doorway(
    way: Tensor, robot_radius: float, generator: torch.Generator, beyond_robot: Draw
) -> Tensor:
    n = len(way)
    x = way * uniform((n,), (0.3, 0.7), generator)
    door = uniform((n,), (-1.0, 1.0), generator)
    half = robot_radius + uniform((n,), beyond_robot, generator) / 2
    length = torch.full_like(x, 2.5)
    return torch.stack([_wall(x, door + s * (half + length), length) for s in (1, -1)], dim=1)


def _wall(x: Tensor, y: Tensor, half: Tensor, width: Tensor | float = _WALL) -> Tensor:
    """A box ``[n, 5]`` that stands across the x axis."""
    yaw, width = torch.full_like(x, math.pi / 2), torch.zeros_like(x) + width
    return torch.stack((x, y, yaw, half, width), dim=-1)
