"""What messages say, in the numbers that a policy's runner takes. No ROS is needed to read them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from torchrl_morl.deploy import LidarGeometry

from .geometry import Pose, yaw


class Person(NamedTuple):
    """Somebody who was seen: where in the frame of the message, and how fast if it tells."""

    position: Any  # geometry_msgs/Point
    velocity: Any | None = None  # likewise, m/s


def seconds(stamp: Any) -> float:
    """Of a ``builtin_interfaces/Time``.

    Example:
        >>> from types import SimpleNamespace
        >>> seconds(SimpleNamespace(sec=12, nanosec=250_000_000))
        12.25
    """
    return stamp.sec + stamp.nanosec * 1e-9


def frame(message: Any) -> str:
    """Of a message with a header; tf2 knows names without the slash that ROS 1 had in front."""
    return message.header.frame_id.lstrip("/")


def lidar_geometry(scan: Any, mount: Pose, upside_down: bool = False) -> LidarGeometry:
    """The lidar of a ``sensor_msgs/LaserScan``.

    Args:
        scan: the message.
        mount: of the lidar on the robot.
        upside_down: seen from above its beams then run the other way.

    Raises:
        ValueError: for fields that describe no lidar; the message names the field.
    """
    turn = -1.0 if upside_down else 1.0
    return LidarGeometry(
        first_angle=turn * scan.angle_min,
        increment=turn * scan.angle_increment,
        num_beams=len(scan.ranges),
        range_min=float(scan.range_min),
        # Simulators report an endless range; no policy was trained with that much.
        range_max=1e3 if scan.range_max == math.inf else float(scan.range_max),
        mount=tuple(mount),
    )


def ranges(scan: Any) -> np.ndarray:
    """``[num_beams]``, metres, float64."""
    return np.asarray(scan.ranges, dtype=np.float64)


def has_valid_beam(scan: Any) -> bool:
    """Whether one beam at least says something: is no NaN, and not below ``range_min``."""
    values = ranges(scan)
    return bool(((values >= max(scan.range_min, 1e-9)) | (values == -math.inf)).any())


def planar_pose(pose: Any) -> Pose:
    """Of a ``geometry_msgs/Pose``.

    Raises:
        ValueError: if it is no pose: not finite, or without an orientation.
    """
    heading = yaw(pose.orientation)
    found = Pose(pose.position.x, pose.position.y, heading)
    if not all(map(math.isfinite, found)):
        raise ValueError(f"the pose is not finite: {tuple(found)}.")
    return found


def people(message: Any, kind: str) -> Iterator[Person]:
    """Whom a message tells of.

    Args:
        message: of topic ``human``.
        kind: its type, one of :data:`~torchrl_morl_ros.settings.HUMAN_MESSAGES`.
    """
    if kind == "geometry_msgs/msg/PoseStamped":
        yield Person(message.pose.position)
    elif kind == "geometry_msgs/msg/PoseArray":
        for pose in message.poses:
            yield Person(pose.position)
    else:
        for person in message.people:
            yield Person(person.position, person.velocity)
