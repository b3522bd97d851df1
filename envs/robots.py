"""Robots as data: dimensions, limits, lidar mounting and actuation of a differential-drive base."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchrl_morl.arguments import is_number

from .fields import Fields, is_description, is_name, number_hint, shown

_LIMITS = {
    "radius": (2.0, "metres"),
    "height": (3.0, "metres"),
    "mass": (1000.0, "kilograms"),
    "max_speed": (10.0, "m/s"),
    "max_turn_rate": (4 * math.pi, "rad/s"),
    "lidar_fov": (2 * math.pi, "radians"),
    "lidar_range": (100.0, "metres"),
    "linear_response": (5.0, "seconds"),
    "angular_response": (5.0, "seconds"),
    "wheel_radius": (0.5, "metres"),
    "wheel_separation": (3.0, "metres"),
}
"""What is above zero, and at most this."""


@dataclasses.dataclass(frozen=True)
class Robot:
    """A differential-drive robot. Lengths in metres, angles in radians, times in seconds.

    Args:
        name: what messages and cards call it.
        radius: radius of its circular footprint, at most 2.
        height: height of its body, at most 3.
        mass: kilograms, at most 1000.
        max_speed: largest forward speed, m/s, at most 10; the base does not drive backwards.
        max_turn_rate: largest turn rate to either side, rad/s, at most two revolutions a second.
        lidar_offset: how far the lidar sits ahead of the rotation centre, within the footprint.
        lidar_fov: field of view, symmetric about the heading; rays outside report no return.
        lidar_range: how far it sees, at most 100; what is further reports no return. What no return
            reads is an argument of the environment, ``max_range``.
        linear_response: time constant of the forward velocity servo, at most 5.
        angular_response: time constant of the turn rate servo, at most 5.
        wheel_radius: of the driven wheels (wheeled drive only), at most 0.5.
        wheel_separation: between the driven wheels' contact points (wheeled drive only), at most 3.

    Raises:
        ValueError: for a value of another type or outside these limits.

    Examples:
        >>> import math
        >>> robot = Robot("mine", radius=0.25, max_speed=0.8, lidar_fov=math.radians(270))
        >>> Robot("mine", radius=0.25, lidar_fov=270)
        Traceback (most recent call last):
            ...
        ValueError: robot 'mine': lidar_fov must be a number above 0 and at most 6.283 radians, got 270. 270 degrees are 4.712.
    """

    name: str
    radius: float
    height: float = 0.5
    mass: float = 5.0
    max_speed: float = 0.5
    max_turn_rate: float = math.pi
    lidar_offset: float = 0.0
    lidar_fov: float = 2 * math.pi
    linear_response: float = 0.024
    angular_response: float = 0.019
    wheel_radius: float = 0.035
    wheel_separation: float = 0.23
    lidar_range: float = 100.0

    def __post_init__(self) -> None:
        if not is_name(self.name):
            raise ValueError(f"robot: name must be text of one line, got {shown(self.name)}.")
        for field, (most, unit) in _LIMITS.items():
            value = getattr(self, field)
            if not (is_number(value) and 0 < value <= most):
                self._refuse(field, f"above 0 and at most {most:.4g} {unit}")
        if not (is_number(self.lidar_offset) and abs(self.lidar_offset) <= self.radius):
            self._refuse("lidar_offset", f"of metres within the radius of {self.radius:g}")

    def _refuse(self, field: str, allowed: str) -> None:
        value = getattr(self, field)
        hint = number_hint(value)
        if field in ("lidar_fov", "max_turn_rate") and is_number(value) and 0 < value <= 3600:
            hint = f"{value:g} degrees are {math.radians(value):.4g}."
        raise ValueError(
            f"robot {self.name!r}: {field} must be a number {allowed}, got {shown(value)}."
            + (f" {hint}" if hint else "")
        )


TURTLEBOT2 = Robot(name="turtlebot2", radius=0.177, height=0.42, mass=2.4)
"""Kobuki base (wheel separation 0.23 m, wheel radius 0.035 m), 360 degree lidar at its centre."""

HSR = Robot(
    name="hsr",
    radius=0.215,
    height=1.0,
    mass=37.0,
    lidar_offset=0.15,
    lidar_fov=math.radians(270.0),
    linear_response=0.3,
    angular_response=0.2,
    wheel_radius=0.05,
    wheel_separation=0.28,
)
"""HSR-like base: 270 degree lidar ahead of the rotation centre, slower actuation."""

ROBOTS: dict[str, Robot] = {robot.name: robot for robot in (TURTLEBOT2, HSR)}


def get_robot(robot: str | Path | Mapping[str, Any] | Robot) -> Robot:
    """Return the robot of that name or description, or the robot itself.

    Args:
        robot: a name from :data:`ROBOTS`, the path of a YAML file (``.yaml``, ``.yml``), a mapping, or
            a :class:`Robot`. Files and mappings hold fields of :class:`Robot`; ``radius`` alone is
            needed, and ``name`` is the file's unless it is given.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if no robot has that name, and for a field that does not exist or is refused.

    Examples:
        >>> get_robot({"name": "mine", "radius": 0.25, "max_speed": 0.8}).max_turn_rate
        3.141592653589793
    """
    if isinstance(robot, Robot):
        return robot
    if isinstance(robot, str) and robot in ROBOTS:
        return ROBOTS[robot]
    if not is_description(robot):
        raise ValueError(
            f"Unknown robot {shown(robot)}: choose one of {sorted(ROBOTS)}, the path of a .yaml "
            "file, a mapping of fields, or an envs.Robot."
        )
    fields = Fields(robot, "robot", [field.name for field in dataclasses.fields(Robot)])
    if "radius" not in fields.values:
        raise ValueError(f"{fields.where}: radius is missing, in metres.")
    try:
        return Robot(**{**fields.values, "name": fields.name})
    except ValueError as error:
        raise ValueError(f"{fields.where}: {error}") from None
