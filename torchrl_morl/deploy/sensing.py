"""What a policy senses and what it commands: the contract between training and robot."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

from .entries import Entries
from .onnx_runner import NUM_COMMANDS, numbers_of

__all__ = ["Limits", "Sensing"]

NUM_ROBOT = 6
"""Numbers of a robot that a policy may read."""

NUM_BASE = 3
"""The first of them; the others are of its lidar."""

NUM_MOTION = 2 + 2 * NUM_COMMANDS
"""Speeds and turn rates, measured and commanded, that come with them."""

SMALLEST = 1e-3
"""Of a robot's radius, limits, view and range."""

LARGEST = {
    "radius": (2.0, "m"),
    "top speed": (10.0, "m/s"),
    "top turn rate": (12.6, "rad/s"),
    "view of the lidar": (6.3, "rad"),
    "range of the lidar": (100.0, "m"),
}
"""What they are at most, as in a file of a robot; angles beyond are degrees by mistake, lengths millimetres."""

# Files from before there were these lack them.
_LATER = ("observe_robot", "observe_nobody", "observe_motion")


@dataclasses.dataclass(frozen=True)
class Sensing:
    """What a policy was trained to sense. Lengths in metres, angles in radians.

    The frame of the robot has its origin at the rotation centre, x ahead and y to the left; angles
    grow counter-clockwise. Goal and human are measured from the rotation centre, ranges from
    :attr:`lidar_origin`.

    Args:
        num_sectors: of the lidar: sector ``k`` covers the bearings from ``k`` to ``k + 1`` times its
            width, counter-clockwise from straight ahead, and is the shortest range in it.
        max_range: of the lidar in training. What is free, or further, reads so.
        lidar_origin: where ranges are measured from, x and y.
        goal_scale: distance to the goal that the network sees as 1.
        human_scale: distance to the human that the network sees as 1.
        observe_human: whether the policy reads where the human is. The lidar sees them anyway.
        observe_human_velocity: whether it reads the human's velocity.
        goal_range: distances to the goal in training, shortest and longest. Longer ones are clamped.
        human_range: the same for the human.
        nobody: distance and bearing of the human that stands for nobody.
        unknown_range: what a sector of which nothing is known reads.
        observe_robot: whether it reads which robot it drives: see
            :func:`torchrl_morl.deploy.features.observation`.
        observe_nobody: whether it reads a mark for nobody.
        observe_motion: whether it reads how the robot moves, and its own last four commands.
        history: observations that the policy reads, the present one included.

    Raises:
        ValueError: for a value outside what is said above; the message names it.

    Example:
        >>> Sensing(observe_human_velocity=True).observation_size
        38
        >>> Sensing(max_range=0.0)
        Traceback (most recent call last):
        ...
        ValueError: sensing: max_range must be finite and positive, got 0.0.
    """

    num_sectors: int = 30
    max_range: float = 4.0
    lidar_origin: tuple[float, float] = (0.0, 0.0)
    goal_scale: float = 5.0
    human_scale: float = 2.0
    observe_human: bool = True
    observe_human_velocity: bool = False
    goal_range: tuple[float, float] = (0.3, 12.0)
    human_range: tuple[float, float] = (0.4, 8.0)
    nobody: tuple[float, float] = (4.0, math.pi)
    unknown_range: float = 4.0
    history: int = 1
    observe_robot: bool = False
    observe_nobody: bool = False
    observe_motion: bool = False

    def __post_init__(self) -> None:
        for name in ("max_range", "goal_scale", "human_scale", "unknown_range"):
            if not 0 < getattr(self, name) < math.inf:
                raise self._refused(name, "finite and positive")
        for name in ("goal_range", "human_range"):
            low, high = getattr(self, name)
            if not 0 <= low < high < math.inf:
                raise self._refused(name, "two distances in ascending order")
        for name in ("lidar_origin", "nobody"):
            if len(getattr(self, name)) != 2 or not all(map(math.isfinite, getattr(self, name))):
                raise self._refused(name, "two finite numbers")
        if self.nobody[0] <= 0:
            raise self._refused("nobody", "at a positive distance")
        if self.unknown_range > self.max_range:
            raise self._refused("unknown_range", f"at most max_range, {self.max_range}")
        if not 1 <= self.num_sectors <= 10_000:
            raise self._refused("num_sectors", "between 1 and 10000")
        if self.observe_human_velocity and not self.observe_human:
            raise self._refused("observe_human_velocity", "false where observe_human is")
        if self.observe_nobody and not self.observe_human:
            raise self._refused("observe_nobody", "false where observe_human is")
        if self.history != 1:
            raise self._refused("history", "1: this version reads one observation")

    @property
    def observation_size(self) -> int:
        """Entries of the network's observation."""
        human = 3 * self.observe_human + 2 * self.observe_human_velocity + self.observe_nobody
        own = NUM_ROBOT * self.observe_robot + NUM_MOTION * self.observe_motion
        return self.num_sectors + 3 + human + own

    def robot(self, numbers: Sequence[float] | None) -> tuple[float, ...] | None:
        """The robot that a policy is to drive: radius (m), top speed (m/s), top turn rate (rad/s), and the
        lidar's view (rad), range (m) and distance ahead of the rotation centre (m); else ``None``.

        Raises:
            ValueError: for a robot that the policy does not read, none where it does, or what is none.

        Example:
            >>> Sensing(observe_robot=True).robot([0.2, 0.5, 3, 6.28, 4, 0])
            (0.2, 0.5, 3.0, 6.28, 4.0, 0.0)
            >>> Sensing().robot([0.2, 0.5, 3, 6.28, 4, 0])
            Traceback (most recent call last):
            ...
            ValueError: this policy does not read robot=, sensing.observe_robot is false.
        """
        if not self.observe_robot:
            if numbers is not None:
                raise ValueError(
                    "this policy does not read robot=, sensing.observe_robot is false."
                )
            return None
        if numbers is None:
            raise ValueError(
                "this policy reads which robot it drives (sensing.observe_robot): give robot=, its "
                "radius (m), top speed (m/s) and top turn rate (rad/s)."
            )
        found = numbers_of("robot", numbers, "six numbers", NUM_ROBOT)
        check_robot_numbers(found)
        return found

    def of_robot(self, robot: Sequence[float]) -> Sensing:
        """The same on one robot, whose lidar is where it says.

        Args:
            robot: its six numbers, as :meth:`robot` returns them.

        Example:
            >>> Sensing(observe_robot=True).of_robot((0.2, 0.5, 3.0, 6.28, 4.0, 0.1)).lidar_origin
            (0.1, 0.0)
        """
        return dataclasses.replace(self, lidar_origin=(robot[-1], 0.0))

    def check(self, available: Sensing, source: str = "this environment") -> None:
        """Refuse what shows a policy something else than it was trained with.

        Args:
            available: what is shown.
            source: what messages call that.

        Raises:
            ValueError: the message says what to change.
        """
        for name, reads in (
            ("observe_human", "where the human is"),
            ("observe_human_velocity", "the human's velocity"),
            ("observe_nobody", "a mark for nobody"),
            ("observe_robot", "which robot it drives"),
            ("observe_motion", "how the robot moves"),
        ):
            mine, theirs = getattr(self, name), getattr(available, name)
            if mine != theirs:
                verb = "reads" if mine else "does not read"
                raise ValueError(
                    f"this policy {verb} {reads}: {name}={mine} ({source} has {theirs})."
                )
        for name in ("num_sectors", "max_range", "goal_scale", "human_scale", "history"):
            mine, theirs = getattr(self, name), getattr(available, name)
            if mine != theirs:
                raise ValueError(
                    f"this policy was trained with {name}={mine}, {source} has {theirs}: "
                    f"set {name}={mine}."
                )

    def to_json(self) -> dict[str, Any]:
        """As JSON values; what older versions do not know is left out where it is not needed."""
        values = dataclasses.asdict(self)
        return {name: one for name, one in values.items() if one or name not in _LATER}

    @classmethod
    def from_json(cls, entries: Entries) -> Sensing:
        """From JSON values.

        Raises:
            ValueError: for an entry that is missing, unknown or of another type.
        """
        readers = {bool: entries.flag, float: entries.number, int: entries.integer}
        values: dict[str, Any] = {}
        for field in dataclasses.fields(cls):
            if field.name in _LATER and field.name not in entries:
                continue
            if isinstance(field.default, tuple):
                values[field.name] = entries.numbers(field.name, 2)
            else:
                values[field.name] = readers[type(field.default)](field.name)
        _refuse_unknown(entries, values)
        return cls(**values)

    def _refused(self, name: str, allowed: str) -> ValueError:
        return ValueError(f"sensing: {name} must be {allowed}, got {getattr(self, name)}.")


@dataclasses.dataclass(frozen=True)
class Limits:
    """What a policy commands at the ends of its action, [-1, 1].

    Args:
        speed: forward, slowest and fastest, m/s.
        turn_rate: to the right (negative) and to the left, rad/s.

    Raises:
        ValueError: for a pair that is not finite and in ascending order.

    Example:
        >>> Limits(speed=(0.5, 0.0))
        Traceback (most recent call last):
        ...
        ValueError: limits: speed must be two finite numbers in ascending order, got (0.5, 0.0).
    """

    speed: tuple[float, float] = (0.0, 0.5)
    turn_rate: tuple[float, float] = (-math.pi, math.pi)

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            low, high = getattr(self, field.name)
            if not -math.inf < low < high < math.inf:
                raise ValueError(
                    f"limits: {field.name} must be two finite numbers in ascending order, "
                    f"got {(low, high)}."
                )

    @classmethod
    def of_robot(cls, max_speed: float, max_turn_rate: float) -> Limits:
        """Those of a robot that drives forwards from 0 and turns to both sides.

        Args:
            max_speed: m/s.
            max_turn_rate: rad/s.

        Raises:
            ValueError: unless both are finite and above 0.

        Example:
            >>> Limits.of_robot(0.8, 2.0)
            Limits(speed=(0.0, 0.8), turn_rate=(-2.0, 2.0))
        """
        return cls((0.0, max_speed), (-max_turn_rate, max_turn_rate))

    def to_json(self) -> dict[str, Any]:
        """As JSON values."""
        return dataclasses.asdict(self)

    @classmethod
    def from_json(cls, entries: Entries) -> Limits:
        """From JSON values.

        Raises:
            ValueError: for an entry that is missing, unknown or of another type.
        """
        values = {field.name: entries.numbers(field.name, 2) for field in dataclasses.fields(cls)}
        _refuse_unknown(entries, values)
        return cls(**values)


def _refuse_unknown(entries: Entries, known: dict[str, Any]) -> None:
    for name in entries:
        if name not in known:
            raise ValueError(f"{entries.where}: unknown entry {name[:80]!r}.")


def check_robot_numbers(robot: Sequence[float]) -> None:
    """Refuse six numbers that no robot has.

    Args:
        robot: finite, as :meth:`Sensing.robot` takes them.

    Raises:
        ValueError: for the first that is out of bounds.

    Example:
        >>> check_robot_numbers((0.2, 0.5, 90.0, 6.28, 4.0, 0.0))
        Traceback (most recent call last):
        ...
        ValueError: robot: the top turn rate must be at most 12.6 rad/s, got 90; 90 degrees are 1.571.
    """
    if min(robot[:-1]) < SMALLEST:
        raise ValueError(
            f"robot must have a radius, limits, view and range above 0, got {tuple(robot)}."
        )
    for (name, (most, unit)), value in zip(LARGEST.items(), robot[:-1], strict=True):
        if value > most:
            hint = f"; {value:g} degrees are {math.radians(value):.4g}" if "rad" in unit else ""
            raise ValueError(
                f"robot: the {name} must be at most {most:g} {unit}, got {value:g}{hint}."
            )
    if abs(robot[-1]) > robot[0]:
        raise ValueError(
            f"robot: the lidar must be within the radius of {robot[0]:g} m, got {robot[-1]:g} m ahead."
        )
