"""Robots as data: dimensions, limits, lidar mounting and actuation of a differential-drive base."""

from __future__ import annotations

import dataclasses
import math


@dataclasses.dataclass(frozen=True)
class Robot:
    """A differential-drive robot. Lengths in metres, angles in radians, times in seconds.

    Args:
        name: what messages and cards call it.
        radius: radius of its circular footprint.
        height: height of its body.
        mass: kilograms.
        max_speed: largest forward speed, m/s; the base does not drive backwards.
        max_turn_rate: largest turn rate to either side, rad/s.
        lidar_offset: how far the lidar sits ahead of the rotation centre.
        lidar_fov: field of view, symmetric about the heading; rays outside report no return.
        linear_response: time constant of the forward velocity servo.
        angular_response: time constant of the turn rate servo.
        wheel_radius: of the driven wheels (wheeled drive only).
        wheel_separation: between the driven wheels' contact points (wheeled drive only).
    """

    name: str
    radius: float
    height: float
    mass: float
    max_speed: float = 0.5
    max_turn_rate: float = math.pi
    lidar_offset: float = 0.0
    lidar_fov: float = 2 * math.pi
    linear_response: float = 0.024
    angular_response: float = 0.019
    wheel_radius: float = 0.035
    wheel_separation: float = 0.23


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


def get_robot(robot: str | Robot) -> Robot:
    """Return the robot of that name, or the robot itself.

    Raises:
        ValueError: if no robot has that name.
    """
    if isinstance(robot, Robot):
        return robot
    if robot not in ROBOTS:
        raise ValueError(
            f"Unknown robot {robot!r}: choose one of {sorted(ROBOTS)}, or pass an envs.Robot."
        )
    return ROBOTS[robot]
