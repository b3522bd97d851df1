"""What the robot was last told of each kind, and whether that is enough to drive."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import numpy as np

from torchrl_morl.deploy import LidarGeometry

from . import messages
from .frames import Frames, Lookup
from .geometry import Pose, mounted, quaternion, rotate
from .settings import Settings

_YEARS = 1e8
"""Seconds; what is older is stamped by a simulation, whose clock begins at 0."""
_SAME_CLOCK = "give all nodes the same use_sim_time and synchronise their machines"


class Fault(NamedTuple):
    """Why the robot must stand: a word for machines, and a line for people."""

    reason: str
    detail: str


class Seen(NamedTuple):
    """Somebody, in the frame of the odometry: metres and m/s."""

    position: tuple[float, float]
    velocity: tuple[float, float] | None


@dataclasses.dataclass
class Inputs:
    """The last message of each topic.

    Args:
        settings: of the node.
        period: of the policy, seconds: what a timeout of 0 means.
        lookup: of tf2, or ``None``.
    """

    settings: Settings
    period: float
    lookup: Lookup | None = None

    def __post_init__(self) -> None:
        settings = self.settings
        given = {
            "scan": settings.scan_timeout,
            "odom": settings.odom_timeout,
            "human": settings.human_timeout,
        }
        self.timeouts = {name: value or self.period for name, value in given.items()}
        self.frames = Frames(settings.base_frame_id, settings.odom_frame_id, self.lookup)
        self.ranges: np.ndarray | None = None
        self.lidar: LidarGeometry | None = None
        self.people: list[Seen] = []
        self.stamps: dict[str, float] = {}
        self._faults: dict[str, Fault] = {}
        self._mount: dict[str, tuple[Pose, bool]] = {}
        self._goal: Any = None
        self.arrived = False

    # --- messages --------------------------------------------------------------------------------

    def take_scan(self, scan: Any) -> None:
        """A ``sensor_msgs/LaserScan``."""
        self._begin("scan", scan)
        if not messages.has_valid_beam(scan):
            self._faults["scan"] = Fault("no scan", "the scan has no valid beam")
            return
        try:
            geometry = messages.lidar_geometry(scan, *self._mounted(messages.frame(scan)))
        except (ValueError, LookupError) as error:
            self._faults["scan"] = Fault("refused", f"scan: {error}".rstrip("."))
            return
        if geometry != self.lidar:  # what it has worked out of its angles is kept
            self.lidar = geometry
        self.ranges = messages.ranges(scan)

    def take_odometry(self, odometry: Any) -> None:
        """A ``nav_msgs/Odometry``."""
        self._begin("odom", odometry)
        frame, expected = messages.frame(odometry), self.settings.odom_frame_id
        try:
            if frame != expected:
                raise ValueError(f"it is in frame {frame!r}, odom_frame_id is {expected!r}")
            pose = messages.planar_pose(odometry.pose.pose)
        except ValueError as error:
            self._faults["odom"] = Fault("refused", f"odometry: {error}".rstrip("."))
            return
        self.frames.add(self.stamps["odom"], pose)

    def take_people(self, message: Any) -> None:
        """Who is there: a message of the type ``human_message``."""
        self._begin("human", message)
        frame, stamp = messages.frame(message), self.stamps["human"]
        try:
            self.people = [
                Seen(self.frames.fixed(one.position, frame, stamp), self._velocity(one, frame))
                for one in messages.people(message, self.settings.human_message)
            ]
        except (ValueError, LookupError) as error:
            self._faults["human"] = Fault("refused", f"human: {error}".rstrip("."))

    def take_goal(self, goal: Any) -> None:
        """A ``geometry_msgs/PoseStamped``; it holds until another one comes or it is reached."""
        frame, stamp = messages.frame(goal), messages.seconds(goal.header.stamp)
        self._faults.pop("goal", None)
        self._goal, self.arrived = (frame, goal.pose.position), False
        if frame != self.settings.base_frame_id:
            return  # asked anew at every step: a localisation may move the frame
        try:
            # It stays where it was, and does not move on with the robot.
            self._goal = None, self.frames.fixed(goal.pose.position, frame, stamp)
        except (ValueError, LookupError) as error:
            self._faults["goal"] = Fault("refused", f"goal: {error}".rstrip("."))

    def forget_goal(self) -> None:
        """There is none any more."""
        self._goal, self.arrived = None, False
        self._faults.pop("goal", None)

    # --- what is known ---------------------------------------------------------------------------

    def fault(self, now: float) -> Fault | None:
        """Why the robot must not drive at this time; ``None`` if all is well."""
        for name in ("scan", "odom", "human"):
            if name == "human" and self.settings.human_message == "none":
                continue
            found = self._late(name, now) or self._faults.get(name)
            if found and (found.reason != "human lost" or self.settings.human_lost == "stop"):
                return found
        if self._faults.get("goal"):
            return self._faults["goal"]
        if self.arrived:
            return Fault("goal reached", "waits for another goal")
        if self._goal is None:
            return Fault("no goal", "no goal has come on topic 'goal_pose'")
        return None

    def goal(self) -> tuple[float, float]:
        """The goal in the frame of the odometry.

        Raises:
            LookupError: for a frame that is not known.
            ValueError: for numbers that are not finite.
        """
        frame, point = self._goal
        return point if frame is None else self.frames.fixed(point, frame, 0.0)

    def nearest(self, robot: Pose, now: float) -> Seen | None:
        """Of the people that are there, the nearest one."""
        people = [] if self._late("human", now) else self.people
        return min(people, key=lambda one: robot.polar(one.position)[0], default=None)

    def oldest(self, now: float) -> float:
        """When the oldest input was measured that counts at this time."""
        names = ["scan", "odom"]
        if self.people and not self._late("human", now):
            names.append("human")
        return min(self.stamps[name] for name in names)

    # --- parts -----------------------------------------------------------------------------------

    def _begin(self, name: str, message: Any) -> None:
        self.stamps[name] = messages.seconds(message.header.stamp)
        self._faults.pop(name, None)

    def _late(self, name: str, now: float) -> Fault | None:
        """No message, an old one, or one of another clock."""
        missing, old = {
            "scan": ("no scan", "stale"),
            "odom": ("no odometry", "stale"),
            "human": ("human lost", "human lost"),
        }[name]
        if name not in self.stamps:
            hint = ": for nobody set human_message to 'none'" if name == "human" else ""
            return Fault(missing, f"nothing has come on topic '{name}'{hint}")
        age, allowed = now - self.stamps[name], self.timeouts[name]
        if age > allowed + 1e-9:
            detail = f"{name} is {age:.2f} s old, {name}_timeout is {allowed:g} s"
            if not self.stamps[name]:
                detail = f"{name} has no stamp: whoever publishes it must fill in header.stamp"
            elif age > _YEARS:
                detail += f": two clocks, {_SAME_CLOCK}"
            return Fault(old, detail)
        if age < -self.period:
            told = f"{name} is stamped {-age:.2f} s later than now: two clocks, {_SAME_CLOCK}"
            return Fault("clock", told)
        return None

    def _mounted(self, frame: str) -> tuple[Pose, bool]:
        """Where the lidar is; a lidar does not move on the robot, so that tf2 is asked once."""
        settings = self.settings
        if self.lookup is None or frame == settings.base_frame_id:
            return Pose(*settings.lidar_mount), False
        if frame not in self._mount:
            self._mount[frame] = mounted(self.lookup(settings.base_frame_id, frame))
        return self._mount[frame]

    def _velocity(self, one: messages.Person, frame: str) -> tuple[float, float] | None:
        """In the frame of the odometry; over the ground, so that a robot's own frame will not do."""
        if one.velocity is None or frame == self.settings.base_frame_id:
            return None
        if frame == self.settings.odom_frame_id:
            return one.velocity.x, one.velocity.y
        rotation = quaternion(self.lookup(self.settings.odom_frame_id, frame).rotation)
        return rotate(rotation, (one.velocity.x, one.velocity.y, one.velocity.z))[:2]
