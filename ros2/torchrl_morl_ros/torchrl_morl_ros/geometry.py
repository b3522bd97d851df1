"""Poses on the floor, and what of a transform in space concerns a robot there."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

_UPRIGHT = math.cos(math.radians(10.0))
"""How far the axis of a planar lidar may be tilted: at 4 m, 10 degrees are 0.7 m of height."""


class Pose(NamedTuple):
    """Of one frame in another one, on the floor: metres and radians, counter-clockwise.

    Example:
        >>> robot = Pose(1.0, 2.0, math.pi / 2)
        >>> [round(value, 3) for value in robot.apply((3.0, 0.0))]  # 3 m ahead of it
        [1.0, 5.0]
        >>> [round(value, 3) for value in robot.polar((0.0, 2.0))]  # 1 m to its left
        [1.0, 1.571]
    """

    x: float
    y: float
    yaw: float

    def apply(self, point: Sequence[float]) -> tuple[float, float]:
        """A point of the inner frame, in the outer one."""
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        ahead, left = point[:2]
        return self.x + cos * ahead - sin * left, self.y + sin * ahead + cos * left

    def polar(self, point: Sequence[float]) -> tuple[float, float]:
        """Distance and bearing of a point of the outer frame, from the inner one."""
        x, y = point[0] - self.x, point[1] - self.y
        bearing = math.atan2(y, x) - self.yaw
        return math.hypot(x, y), math.remainder(bearing, 2 * math.pi)


def quaternion(message: Any) -> tuple[float, float, float, float]:
    """x, y, z, w of a ``geometry_msgs/Quaternion``, of length one.

    Raises:
        ValueError: for one of no length, as messages have it that nobody has filled in.

    Example:
        >>> from types import SimpleNamespace
        >>> quaternion(SimpleNamespace(x=0.0, y=0.0, z=0.0, w=0.0))
        Traceback (most recent call last):
        ...
        ValueError: the orientation (0.0, 0.0, 0.0, 0.0) is no rotation: x, y, z, w must have length 1.
    """
    values = (message.x, message.y, message.z, message.w)
    length = math.sqrt(sum(value * value for value in values))
    if not 0.9 < length < 1.1:  # not NaN
        raise ValueError(f"the orientation {values} is no rotation: x, y, z, w must have length 1.")
    x, y, z, w = (value / length for value in values)
    return x, y, z, w


def yaw(message: Any) -> float:
    """Heading of a ``geometry_msgs/Quaternion``, radians.

    Raises:
        ValueError: see :func:`quaternion`.
    """
    x, y, z, w = quaternion(message)
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def rotate(rotation: Sequence[float], point: Sequence[float]) -> tuple[float, float, float]:
    """A point in space, turned by a quaternion x, y, z, w."""
    x, y, z, w = rotation
    px, py, pz = point
    # v + 2 q x (q x v + w v)
    cx, cy, cz = y * pz - z * py + w * px, z * px - x * pz + w * py, x * py - y * px + w * pz
    return (
        px + 2 * (y * cz - z * cy),
        py + 2 * (z * cx - x * cz),
        pz + 2 * (x * cy - y * cx),
    )


def transformed(transform: Any, point: Any) -> tuple[float, float]:
    """Where a point is on the floor, after a ``geometry_msgs/Transform``.

    Cameras look along z: the point is turned in space before its height is left out.
    """
    turned = rotate(quaternion(transform.rotation), (point.x, point.y, point.z))
    return turned[0] + transform.translation.x, turned[1] + transform.translation.y


def mounted(transform: Any) -> tuple[Pose, bool]:
    """How a planar lidar is mounted: where on the robot, and whether upside down.

    Args:
        transform: ``geometry_msgs/Transform`` of the lidar's frame in that of the robot.

    Returns:
        The pose of its x axis, and whether its scan runs clockwise seen from above.

    Raises:
        ValueError: for a lidar whose plane is not the floor's.
    """
    rotation = quaternion(transform.rotation)
    ahead, left, _ = rotate(rotation, (1.0, 0.0, 0.0))
    upward = rotate(rotation, (0.0, 0.0, 1.0))[2]
    if abs(upward) < _UPRIGHT:
        tilt = math.degrees(math.acos(min(1.0, abs(upward))))
        raise ValueError(
            f"the lidar is tilted by {tilt:.0f} degrees, a planar one by at most 10: its transform to "
            "the base is wrong, or it needs pointcloud_to_laserscan."
        )
    place = transform.translation
    return Pose(place.x, place.y, math.atan2(left, ahead)), upward < 0
