"""People in scenes: how one comes along, walks and leaves, as rows of numbers.

A person is seven numbers: x, y, heading, x and y of where they walk to, speed (m/s), and when they set
out (s after the start). They walk in a straight line, yield to nobody, and stand before and after. The
functions here draw one person a scene for a robot that starts at the origin and whose goal lies on the
positive x axis.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

PERSON = ("x", "y", "heading", "goal_x", "goal_y", "speed", "sets_out")
"""The numbers of a person, in their order."""

FAR = 1000.0
"""Where those stand who are not there, and the boxes that are not: beyond this many metres."""

Draw = tuple[float, float]
Person = Callable[[Tensor, torch.Generator], Tensor]
"""``person(way [n], generator)`` draws people ``[n, 7]`` for goals that are ``way`` metres away."""


@dataclasses.dataclass(frozen=True)
class Bound:
    """A function whose last arguments are given. A closure could be neither pickled nor compared.

    Args:
        function: of a module.
        last: its last arguments.
    """

    function: Callable[..., Tensor]
    last: tuple[Any, ...] = ()

    def __call__(self, *first: Any) -> Tensor:
        return self.function(*first, *self.last)


# What the robot of the paper drives: who crosses its way is timed to meet it.
_NOMINAL_SPEED = 0.5

# What the slow robot of :mod:`envs.encounters` takes to turn and to drive 0.8 m, seconds.
_GETS_AWAY = 8.0


def absent(people: Tensor) -> Tensor:
    """Which of the people ``[*B, 2]`` or more entries are not there, bool ``[*B]``."""
    return people[..., 0].abs() >= FAR


def uniform(shape: tuple[int, ...], ends: Draw, generator: torch.Generator) -> Tensor:
    """Evenly from a range, float64."""
    low, high = ends
    return low + (high - low) * torch.rand(shape, generator=generator, dtype=torch.float64)


def person(place: tuple[Tensor, Tensor], goal: tuple[Tensor, Tensor], speed: Tensor, out: Tensor):
    """Rows ``[n, 7]`` of people who walk from a place to a goal, and look there."""
    (x, y), (goal_x, goal_y) = place, goal
    heading = torch.atan2(goal_y - y, goal_x - x)
    return torch.stack((x, y, heading, goal_x, goal_y, speed, out), dim=-1)


def nobody(way: Tensor, generator: torch.Generator) -> Tensor:
    """They are not there."""
    del generator
    row = torch.tensor([-FAR, -FAR, 0.0, -FAR, -FAR, 0.0, 0.0], dtype=torch.float64)
    return row.repeat(len(way), 1)


def standing(way: Tensor, generator: torch.Generator) -> Tensor:
    """Somebody stands near the line to the goal, and looks anywhere."""
    n = len(way)
    x = way * uniform((n,), (0.3, 0.7), generator)
    y = uniform((n,), (-0.5, 0.5), generator)
    still = torch.zeros(n, dtype=torch.float64)
    rows = person((x, y), (x, y), still, still)
    rows[:, 2] = uniform((n,), (-math.pi, math.pi), generator)
    return rows


def towards(speed: Draw) -> Person:
    """Somebody walks from beyond the goal to behind the start, m/s."""
    return Bound(_towards, (speed,))


def _towards(way: Tensor, generator: torch.Generator, speed: Draw) -> Tensor:
    n = len(way)
    y = uniform((n,), (-0.5, 0.5), generator)
    x = way + uniform((n,), (0.0, 2.0), generator)
    end = -uniform((n,), (1.0, 3.0), generator)
    return person((x, y), (end, y), uniform((n,), speed, generator), torch.zeros_like(x))


def crossing(speed: Draw) -> Person:
    """Somebody crosses the way, from the left or the right, about when the robot gets there, m/s."""
    return Bound(_crossing, (speed,))


def _crossing(way: Tensor, generator: torch.Generator, speed: Draw) -> Tensor:
    n = len(way)
    side = torch.where(uniform((n,), (-1.0, 1.0), generator) < 0, -1.0, 1.0)
    middle = way * uniform((n,), (0.25, 0.75), generator)
    pace = uniform((n,), speed, generator)
    meets = (middle / _NOMINAL_SPEED + uniform((n,), (-2.0, 2.0), generator)).clamp_min(2.0)
    away = (pace * meets).clamp(1.5, 6.0)
    sets_out = (meets - away / pace).clamp_min(0.0)
    slant = uniform((2, n), (-1.0, 1.0), generator)
    beyond = uniform((n,), (2.0, 4.0), generator)
    place, goal = (middle + slant[0], side * away), (middle + slant[1], -side * beyond)
    return person(place, goal, pace, sets_out)


def ahead(speed: Draw) -> Person:
    """Somebody walks ahead of the robot in its direction, m/s."""
    return Bound(_ahead, (speed,))


def _ahead(way: Tensor, generator: torch.Generator, speed: Draw) -> Tensor:
    n = len(way)
    x = uniform((n,), (1.2, 2.5), generator)
    y = uniform((n,), (-0.4, 0.4), generator)
    # They leave the way before the goal, on either side.
    side = torch.where(uniform((n,), (-1.0, 1.0), generator) < 0, -1.0, 1.0)
    aside = side * uniform((n,), (1.0, 2.0), generator)
    end = way * uniform((n,), (0.6, 1.0), generator)
    return person((x, y), (end, aside), uniform((n,), speed, generator), torch.zeros_like(x))


def overtaking(speed: Draw) -> Person:
    """Somebody comes from behind and goes the robot's way, m/s."""
    return Bound(_overtaking, (speed,))


def _overtaking(way: Tensor, generator: torch.Generator, speed: Draw) -> Tensor:
    n = len(way)
    pace = uniform((n,), speed, generator)
    # So far behind that a robot that has to turn first gets out of the way.
    x = -(_GETS_AWAY * pace + uniform((n,), (0.7, 2.0), generator))
    y = uniform((n,), (-0.6, 0.6), generator)
    # They pass the goal on either side.
    side = torch.where(uniform((n,), (-1.0, 1.0), generator) < 0, -1.0, 1.0)
    aside = side * uniform((n,), (1.0, 2.0), generator)
    end = way + uniform((n,), (1.0, 3.0), generator)
    return person((x, y), (end, aside), pace, torch.zeros_like(x))


def standing_up(speed: Draw) -> Person:
    """Somebody stands near the way, sets out after a while and walks off in any direction, m/s."""
    return Bound(_standing_up, (speed,))


def _standing_up(way: Tensor, generator: torch.Generator, speed: Draw) -> Tensor:
    n = len(way)
    x = way * uniform((n,), (0.3, 0.7), generator)
    y = uniform((n,), (-1.0, 1.0), generator)
    direction = uniform((n,), (-math.pi, math.pi), generator)
    length = uniform((n,), (3.0, 5.0), generator)
    goal = x + length * direction.cos(), y + length * direction.sin()
    sets_out = uniform((n,), (2.0, 12.0), generator)
    return person((x, y), goal, uniform((n,), speed, generator), sets_out)


def any_of(*people: Person) -> Person:
    """One of several, drawn evenly in each scene."""
    return Bound(_any_of, people)


def _any_of(way: Tensor, generator: torch.Generator, *people: Person) -> Tensor:
    rows = torch.stack([one(way, generator) for one in people])
    which = torch.randint(len(people), (len(way),), generator=generator)
    return rows[which, torch.arange(len(way))]


def place_at(people: Tensor, time: Tensor | float) -> Tensor:
    """Where people are some seconds after the start if nothing holds them up.

    Args:
        people: ``[*B, 7]``.
        time: ``[*B]``, or one number.

    Returns:
        ``[*B, 2]``, metres.

    Examples:
        >>> import torch
        >>> someone = torch.tensor([0.0, 0.0, 0.0, 4.0, 0.0, 0.5, 2.0])
        >>> place_at(someone, 6.0), place_at(someone, 60.0)
        (tensor([2., 0.]), tensor([4., 0.]))
    """
    place, goal = people[..., :2], people[..., 3:5]
    way = goal - place
    length = way.norm(dim=-1)
    walked = (time - people[..., 6]).clamp_min(0.0) * people[..., 5]
    return place + way * (walked / length.clamp_min(1e-9)).clamp_max(1.0)[..., None]
