"""Tracks of robot, human and goals from the topics of a ROS bag."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

Stamps = Literal["header", "received"]

_ROBOT = ("nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseWithCovarianceStamped")
_POSE, _ARRAY = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseArray"
_PEOPLE = "people_msgs/msg/People"
_TYPES = {
    "robot": (*_ROBOT, _POSE),
    "human": (_POSE, _ARRAY, _PEOPLE),
    "goal": (_POSE, "geometry_msgs/msg/PointStamped"),
}
_TWO_CLOCKS = 5.0
"""Seconds by which stamps of two topics may differ, compared with when they were received."""


@dataclasses.dataclass(frozen=True)
class BagTopics:
    """Which topics of a bag tell of the robot, the human and the goals.

    Args:
        robot: ``Odometry``, ``PoseStamped`` or ``PoseWithCovarianceStamped``.
        human: ``PoseStamped``, ``PoseArray`` or ``people_msgs/People``; of many people the nearest
            one counts.
        goal: ``PoseStamped`` or ``PointStamped``; each other goal begins a drive. ``None``: a drive
            ends where the robot stands for three seconds, and that is its goal.
        stamps: whether messages are of the time in their header, or of that when they were received.

    Raises:
        ValueError: for the same topic twice, or other stamps.
    """

    robot: str = "/odom"
    human: str = "/human"
    goal: str | None = "/goal_pose"
    stamps: Stamps = "header"

    def __post_init__(self) -> None:
        names = [name for name in self.named().values() if name]
        if len(set(names)) < len(names):
            raise ValueError(f"robot, human and goal must be different topics, got {names}.")
        if self.stamps not in ("header", "received"):
            raise ValueError(f"stamps must be 'header' or 'received', got {self.stamps!r}.")

    def named(self) -> dict[str, str]:
        """Those that are to be read, by what they tell of."""
        named = {"robot": self.robot, "human": self.human, "goal": self.goal}
        return {what: name for what, name in named.items() if name}


class Track(NamedTuple):
    """What one topic tells, in the order of time.

    Args:
        time: seconds, ``[M]``.
        points: x, y (m) and heading (rad) of what is told at each time; several for an array.
        frame: of the messages.
        child: for a robot, the frame that is its own.
    """

    time: np.ndarray
    points: list[np.ndarray]
    frame: str
    child: str = ""


def read_tracks(
    path: Path, topics: BagTopics, progress: Callable[..., Iterable[Any]]
) -> dict[str, Track]:
    """The tracks ``robot``, ``human`` and, unless the topics have none, ``goal``.

    Args:
        path: a bag: a folder with ``metadata.yaml``, an ``.mcap``, or a ROS 1 ``.bag``.
        topics: their names.
        progress: see :func:`envs.demonstrations.import_demonstrations`.

    Raises:
        ImportError: without ``rosbags``.
        ValueError: if it is no bag, or a topic is missing, empty or of another type.
    """
    with _opened(path) as reader:
        found = _connections(path, reader, topics)
        wanted = [connection for each in found.values() for connection in each]
        told: dict[str, list[tuple[float, float, np.ndarray, str, str]]] = {w: [] for w in found}
        owner = {id(one): what for what, each in found.items() for one in each}
        count = sum(connection.msgcount for connection in wanted)
        for connection, received, raw in progress(
            reader.messages(wanted), desc=f"reading {path.name}", total=count
        ):
            message = reader.deserialize(raw, connection.msgtype)
            header = message.header
            stamp = header.stamp.sec + header.stamp.nanosec * 1e-9
            told[owner[id(connection)]].append(
                (
                    stamp,
                    received * 1e-9,
                    _points(message, connection.msgtype),
                    header.frame_id.lstrip("/"),
                    getattr(message, "child_frame_id", "").lstrip("/"),
                )
            )
    return _tracks(path, told, topics)


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Any]:
    try:
        from rosbags.highlevel import AnyReader, AnyReaderError
        from rosbags.typesys import Stores, get_typestore
    except ModuleNotFoundError as error:
        raise ImportError(
            f"{path}: bags need the package rosbags: pip install -c constraints.txt rosbags."
        ) from error
    try:
        # Bags of sqlite3 have no definitions of their types.
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
            yield reader
    except (AnyReaderError, OSError, AssertionError, KeyError) as error:
        raise ValueError(f"{path} is no bag that can be read: {_line(error)}.") from error


def _line(error: Exception) -> str:
    return " ".join(f"{type(error).__name__} {error}".split()).rstrip(".")


def _connections(path: Path, reader: Any, topics: BagTopics) -> dict[str, list[Any]]:
    """Those of each topic, by what it tells of."""
    there = {connection.topic: connection.msgtype for connection in reader.connections}
    found = {}
    for what, name in topics.named().items():
        each = [one for one in reader.connections if one.topic in (name, f"/{name}")]
        if not each or not sum(one.msgcount for one in each):
            fits = [topic for topic, kind in sorted(there.items()) if kind in _TYPES[what]]
            state = "is empty in" if each else "is not in"
            raise ValueError(
                f"topic {name} for the {what} {state} {path}: of a type that fits are "
                f"{', '.join(fits) or 'none'}, all are {', '.join(sorted(there)) or 'none'}: "
                f"--{what}-topic."
            )
        if each[0].msgtype not in _TYPES[what]:
            raise ValueError(
                f"{path}, topic {name}: for the {what} messages must be one of "
                f"{', '.join(_TYPES[what])}, got {each[0].msgtype}: --{what}-topic."
            )
        found[what] = each
    return found


def _points(message: Any, kind: str) -> np.ndarray:
    """``[P, 3]``: x, y and heading of everybody that a message tells of."""
    if kind in _ROBOT:
        poses = [message.pose.pose]
    elif kind == _POSE:
        poses = [message.pose]
    elif kind == _ARRAY:
        poses = message.poses
    else:
        places = [one.position for one in message.people] if kind == _PEOPLE else [message.point]
        return np.array([(place.x, place.y, 0.0) for place in places]).reshape(-1, 3)
    found = []
    for pose in poses:
        q = pose.orientation
        yaw = math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z))
        found.append((pose.position.x, pose.position.y, yaw))
    return np.array(found).reshape(-1, 3)


def _tracks(path: Path, told: dict[str, list[tuple]], topics: BagTopics) -> dict[str, Track]:
    """In the order of time, each on the clock of the robot's topic."""
    named, lags, tracks = topics.named(), {}, {}
    for what, messages in told.items():
        frames = sorted({one[3] for one in messages})
        if len(frames) > 1:
            raise ValueError(
                f"{path}, topic {named[what]}: messages in several frames, {', '.join(frames)}."
            )
        stamps, received = (np.array([one[i] for one in messages]) for i in (0, 1))
        if topics.stamps == "received":
            stamps = received
        elif (stamps == 0).any():
            raise ValueError(
                f"{path}, topic {named[what]}: {int((stamps == 0).sum())} message(s) without a stamp "
                "in their header: --stamps received."
            )
        lags[what] = float(np.median(stamps - received))
        if what == "goal":
            # Goals come from desks, with clocks of their own; when they came is what matters.
            stamps = received + lags["robot"]
        elif abs(lags[what] - lags["robot"]) > _TWO_CLOCKS:
            raise ValueError(
                f"{path}: the stamps of {named[what]} and {named['robot']} are of two clocks, "
                f"{abs(lags[what] - lags['robot']):.6g} s apart: --stamps received."
            )
        order = np.argsort(stamps, kind="stable")
        tracks[what] = Track(
            stamps[order], [messages[i][2] for i in order], frames[0], messages[0][4]
        )
    return tracks
