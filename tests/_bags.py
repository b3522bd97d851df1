"""ROS 2 bags of drives, written by rosbags."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

Message = tuple[str, str, float, float, object]
"""Topic, type, stamp of the header, when it was received (s), and what goes into it."""


def write_bag(path: Path, messages: Iterable[Message], *, mcap: bool = True) -> Path:
    """A bag of these messages, as ``ros2 bag record`` leaves it."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    types = store.types

    def header(stamp: float, frame: str):
        time = types["builtin_interfaces/msg/Time"](int(stamp), round(stamp % 1 * 1e9))
        return types["std_msgs/msg/Header"](time, frame)

    def pose(x: float, y: float, yaw: float = 0.0):
        point = types["geometry_msgs/msg/Point"](x, y, 0.0)
        turn = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2))
        return types["geometry_msgs/msg/Pose"](point, turn)

    def made(kind: str, stamp: float, content):
        frame, *values = content
        head = header(stamp, frame)
        if kind == "nav_msgs/msg/Odometry":
            zero = types["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
            twist = types["geometry_msgs/msg/Twist"](zero, zero)
            with_pose = types["geometry_msgs/msg/PoseWithCovariance"](pose(*values), np.zeros(36))
            with_twist = types["geometry_msgs/msg/TwistWithCovariance"](twist, np.zeros(36))
            return types[kind](head, "base_link", with_pose, with_twist)
        if kind == "geometry_msgs/msg/PoseArray":
            return types[kind](head, [pose(*one) for one in values])
        if kind == "std_msgs/msg/String":
            return types[kind](values[0])
        return types[kind](head, pose(*values))

    plugin = StoragePlugin.MCAP if mcap else StoragePlugin.SQLITE3
    with Writer(path, version=9, storage_plugin=plugin) as writer:
        connections = {}
        for topic, kind, stamp, received, content in sorted(messages, key=lambda one: one[3]):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            raw = store.serialize_cdr(made(kind, stamp, content), kind)
            writer.write(connections[topic], round(received * 1e9), raw)
    return path


ODOMETRY, POSE = "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped"


def drive(
    start: float = 100.0,
    *,
    goal: tuple[float, float] | None = (4.0, 0.0),
    human: tuple[float, float] | None = (2.0, 1.5),
    speed: float = 0.4,
    seconds: float = 10.5,
    waits: float = 1.0,
    offset: float = 0.0,
    frame: str = "odom",
    human_frame: str | None = None,
) -> list[Message]:
    """Along x at 30 Hz, from ``offset``; the human at 7 Hz, out of step; a goal before it sets off.

    Messages are received 13 ms after their stamp.
    """
    found: list[Message] = []

    def tell(topic: str, kind: str, stamp: float, *content) -> None:
        found.append((topic, kind, stamp, stamp + 0.013, content))

    for k in range(int((waits + seconds) * 30) + 1):
        t = k / 30
        x = offset + speed * max(0.0, t - waits)
        tell("/odom", ODOMETRY, start + t, frame, x, 0.0, 0.0)
    for k in range(int((waits + seconds) * 7) + 2):
        if human is not None:
            tell("/human", POSE, start - 0.03 + k / 7, human_frame or frame, *human)
    if goal is not None:
        tell("/goal_pose", POSE, start + 0.2, frame, *goal)
    return found
