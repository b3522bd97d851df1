"""Where points of messages are in the fixed frame of the odometry."""

from __future__ import annotations

import bisect
import math
from collections import deque
from collections.abc import Callable
from typing import Any

from .geometry import Pose, transformed

Lookup = Callable[[str, str], Any]
"""``geometry_msgs/Transform`` of a source frame (second) in a target frame (first).

Raises ``LookupError`` with a line that says why there is none.
"""


class Frames:
    """Points in the frames of the robot, of the odometry, and what a ``lookup`` knows beside them.

    Args:
        base: frame of the robot.
        odom: fixed frame in which the odometry tells the pose of the robot.
        lookup: of tf2; without it no other frames are known.
        memory: for how long poses are kept, seconds.

    Example:
        >>> frames = Frames("base_link", "odom")
        >>> frames.add(10.0, Pose(0.0, 0.0, 0.0))
        >>> frames.add(12.0, Pose(1.0, 0.0, 0.0))
        >>> frames.robot_at(11.0)  # between two messages
        Pose(x=0.5, y=0.0, yaw=0.0)
    """

    def __init__(
        self, base: str, odom: str, lookup: Lookup | None = None, memory: float = 2.0
    ) -> None:
        self.base, self.odom, self.lookup, self.memory = base, odom, lookup, memory
        self._poses: deque[tuple[float, Pose]] = deque()

    @property
    def latest(self) -> tuple[float, Pose] | None:
        """Time (s) and pose of the robot as last told."""
        return self._poses[-1] if self._poses else None

    def add(self, stamp: float, pose: Pose) -> None:
        """The pose of the robot at a time; time that goes back begins anew, as simulators do."""
        if self._poses and stamp < self._poses[-1][0]:
            self._poses.clear()
        self._poses.append((stamp, pose))
        while self._poses[0][0] < stamp - self.memory:
            self._poses.popleft()

    def robot_at(self, stamp: float) -> Pose:
        """Where the robot was; outside of what is remembered, at its nearest end.

        A stamp of 0 is now, as for tf2: messages from the command line have it.

        Raises:
            LookupError: before the first odometry.
        """
        if not self._poses:
            raise LookupError("there is no odometry yet")
        if not stamp:
            return self._poses[-1][1]
        after = bisect.bisect_left(self._poses, stamp, key=lambda entry: entry[0])
        if after in (0, len(self._poses)):
            return self._poses[min(after, len(self._poses) - 1)][1]
        (t0, old), (t1, new) = self._poses[after - 1], self._poses[after]
        share = (stamp - t0) / (t1 - t0)
        turn = math.remainder(new.yaw - old.yaw, 2 * math.pi)
        return Pose(
            old.x + share * (new.x - old.x),
            old.y + share * (new.y - old.y),
            old.yaw + share * turn,
        )

    def fixed(self, point: Any, frame: str, stamp: float) -> tuple[float, float]:
        """A ``geometry_msgs/Point`` in the frame of the odometry.

        Args:
            point: as the message has it.
            frame: of the message.
            stamp: when it was measured: where the robot was then counts.

        Raises:
            LookupError: for a frame that is not known.
            ValueError: for numbers that are not finite.
        """
        if not all(map(math.isfinite, (point.x, point.y, point.z))):
            raise ValueError(f"its position is not finite: {(point.x, point.y, point.z)}")
        if not frame:
            raise LookupError("it names no frame: fill in header.frame_id")
        if frame == self.odom:
            return point.x, point.y
        if frame == self.base:
            return self.robot_at(stamp).apply((point.x, point.y))
        if self.lookup is None:
            raise LookupError(
                f"it is in frame {frame!r}, and without tf2 only {self.odom!r} and {self.base!r} are "
                "known: install tf2_ros (with use_tf), or set odom_frame_id or base_frame_id"
            )
        return transformed(self.lookup(self.odom, frame), point)
