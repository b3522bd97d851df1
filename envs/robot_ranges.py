"""Robots that differ from episode to episode: ranges, of which each draws its own."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from torchrl_morl.arguments import is_number

from .fields import Fields, is_description, is_list, shown
from .robots import Robot, get_robot

DRIVEN = (
    "radius",
    "max_speed",
    "max_turn_rate",
    "lidar_fov",
    "lidar_range",
    "lidar_offset",
    "linear_response",
    "angular_response",
)
"""What robots of one batch may differ in. A policy may be told the first six."""

# A file says 3.1416 and means half a revolution.
_ROUNDING = 1e-3
_UNITS = ("m", "m/s", "rad/s", "rad", "m", "of the radius", "s", "s")


@dataclasses.dataclass(frozen=True)
class RobotRanges:
    """Robots of which every episode draws one, each number evenly from a range.

    Args:
        name: what messages and cards call them.
        radius: metres.
        max_speed: m/s.
        max_turn_rate: rad/s.
        lidar_fov: radians.
        lidar_range: metres.
        lidar_offset: ahead of the rotation centre, as a share of the radius.
        linear_response: seconds.
        angular_response: seconds.

    Raises:
        ValueError: for what is no range in ascending order, or whose ends are no robots.

    Examples:
        >>> ranges = RobotRanges(radius=(0.2, 0.3))
        >>> robots = ranges.draw(100, torch.Generator().manual_seed(0))
        >>> robots.shape, bool((robots[:, 0] <= 0.3).all())
        (torch.Size([100, 8]), True)
        >>> ranges.robot(robots[0]).name
        'any'
    """

    name: str = "any"
    radius: tuple[float, float] = (0.12, 0.35)
    max_speed: tuple[float, float] = (0.25, 1.0)
    max_turn_rate: tuple[float, float] = (0.8, math.pi)
    lidar_fov: tuple[float, float] = (math.pi, 2 * math.pi)
    lidar_range: tuple[float, float] = (3.0, 10.0)
    lidar_offset: tuple[float, float] = (-0.5, 0.8)
    linear_response: tuple[float, float] = (0.024, 0.3)
    angular_response: tuple[float, float] = (0.019, 0.2)

    def __post_init__(self) -> None:
        for name in DRIVEN:
            ends = getattr(self, name)
            if isinstance(ends, Sequence) and not isinstance(ends, str):  # of a file: a list
                object.__setattr__(self, name, tuple(ends))
            ends = getattr(self, name)
            if is_number(ends):
                ends = (ends, ends)
                object.__setattr__(self, name, ends)
            if not (
                isinstance(ends, tuple)
                and len(ends) == 2
                and all(map(is_number, ends))
                and ends[0] <= ends[1]
            ):
                raise ValueError(
                    f"robot {self.name!r}: {name} must be a number or a range [low, high], "
                    f"got {shown(ends)}."
                )
        if not all(abs(end) <= 1 for end in self.lidar_offset):
            raise ValueError(
                f"robot {self.name!r}: lidar_offset must be shares of the radius from -1 to 1, "
                f"got {shown(self.lidar_offset)}."
            )
        for index in (0, 1):
            _ = self._end(index)

    def _end(self, index: int) -> Robot:
        numbers = {name: getattr(self, name)[index] for name in DRIVEN}
        numbers["lidar_offset"] *= numbers["radius"]
        return Robot(self.name, **numbers)

    @property
    def largest(self) -> Robot:
        """The one with the high end of each range."""
        return self._end(1)

    def outside(self, robot: Robot | RobotRanges, *, max_range: float = 4.0) -> list[str]:
        """What of a robot, or of other ranges, is not within these, in words; empty if all is.

        Args:
            robot: a robot, or ranges.

        Keyword Args:
            max_range: that scans are cut off at, metres: a lidar that sees further sees as far.

        Examples:
            >>> ANY_ROBOT.outside(Robot("mine", radius=0.5))
            ['radius 0.5 m (trained: 0.12 to 0.35 m)']
        """
        found = []
        for name, unit in zip(DRIVEN, _UNITS, strict=True):
            low, high = getattr(self, name)
            if isinstance(robot, RobotRanges):
                ends = getattr(robot, name)
            else:
                share = robot.radius if name == "lidar_offset" else 1.0
                ends = (getattr(robot, name) / share,) * 2
            if name == "lidar_range":
                cut = min(ends[0], max_range), min(ends[1], max_range)
                inside = min(low, max_range) <= cut[0] and cut[1] <= min(high, max_range)
            else:
                inside = low - _ROUNDING <= ends[0] and ends[1] <= high + _ROUNDING
            if not inside:
                given = (
                    f"{ends[0]:.4g}" if ends[0] == ends[1] else f"{ends[0]:.4g} to {ends[1]:.4g}"
                )
                trained = f"{low:.4g}" if low == high else f"{low:.4g} to {high:.4g}"
                found.append(f"{name} {given} {unit} (trained: {trained} {unit})")
        return found

    def draw(
        self, n: int, generator: torch.Generator, slowest: torch.Tensor | None = None
    ) -> torch.Tensor:
        """Robots ``[n, 8]``, float64, in the order of :data:`DRIVEN`, metres in place of shares.

        Args:
            n: how many.
            generator: of the draws.
            slowest: speeds ``[n]`` below which none is drawn, m/s, as far as the range allows: episodes
                end, so that who has far to go must not crawl.
        """
        low, high = torch.tensor([getattr(self, name) for name in DRIVEN], dtype=torch.float64).T
        low = low.repeat(n, 1)
        if slowest is not None:
            low[:, 1] = torch.maximum(low[:, 1], slowest).clamp_max(high[1])
        robots = low + (high - low) * torch.rand(n, len(DRIVEN), generator=generator).double()
        robots[:, 5] *= robots[:, 0]
        return robots

    def robot(self, numbers: torch.Tensor) -> Robot:
        """One of those that were drawn, ``[8]``."""
        return Robot(self.name, **dict(zip(DRIVEN, numbers.tolist())))


def largest(robots: Robot | RobotRanges) -> Robot:
    """The robot itself, or the one with the high end of each range."""
    return robots.largest if isinstance(robots, RobotRanges) else robots


ANY_ROBOT = RobotRanges()
"""Indoor robots from a vacuum cleaner to a delivery robot."""


def get_robots(robot: str | Path | Mapping[str, Any] | Robot | RobotRanges) -> Robot | RobotRanges:
    """A robot, or the ranges of which every episode draws one.

    Args:
        robot: as of :func:`get_robot`; also ``"any"``, :class:`RobotRanges`, and files and mappings with
            a range [low, high] in place of a number.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: as :func:`get_robot`, and for a range that is refused.

    Examples:
        >>> get_robots({"radius": [0.15, 0.25], "max_speed": 0.5}).largest.radius
        0.25
    """
    if isinstance(robot, RobotRanges):
        return robot
    if isinstance(robot, str) and robot == ANY_ROBOT.name:
        return ANY_ROBOT
    if not is_description(robot):
        return get_robot(robot)
    known = [field.name for field in dataclasses.fields(Robot)]
    fields = Fields(robot, "robot", known)
    ranged = [name for name, value in fields.values.items() if is_list(value)]
    if not ranged:
        return get_robot(robot)
    if "radius" not in fields.values:
        raise ValueError(f"{fields.where}: radius is missing, in metres.")
    defaults = Robot(fields.name, radius=1.0)
    numbers: dict[str, Any] = {}
    for name in fields.values:
        if name != "name" and name not in DRIVEN:
            raise ValueError(
                f"{fields.where}: {name} cannot stand beside a range; those that can are "
                f"{', '.join(DRIVEN)}."
            )
    for name in DRIVEN:
        numbers[name] = fields.values.get(name, getattr(defaults, name))
    try:
        return RobotRanges(fields.name, **numbers)
    except ValueError as error:
        raise ValueError(f"{fields.where}: {error}") from None
