"""Parameters of the node: names, defaults, what they mean, and what they may be."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

HUMAN_MESSAGES = (
    "none",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseArray",
    "people_msgs/msg/People",
)
"""How the node may be told of people; with ``none`` there is never anybody."""


def _parameter(default: Any, description: str) -> Any:
    return dataclasses.field(default=default, metadata={"description": description})


@dataclasses.dataclass(frozen=True)
class Settings:
    """Parameters that are read when the node is configured. Their descriptions are those of ROS.

    Raises:
        ValueError: for a value that makes no sense; the message names the parameter.

    Example:
        >>> Settings(policy="my_policy", publish_rate=0.0)
        Traceback (most recent call last):
        ...
        ValueError: publish_rate must be from 5 to 200 Hz, got 0.0.
    """

    policy: str = _parameter("", "Folder of the policy: policy.json and policy.safetensors.")
    base_frame_id: str = _parameter("base_link", "Frame of the robot: rotation centre, x ahead.")
    odom_frame_id: str = _parameter("odom", "Fixed frame in which the odometry tells the pose.")
    human_message: str = _parameter(
        HUMAN_MESSAGES[1], f"Type of topic 'human', one of: {', '.join(HUMAN_MESSAGES)}."
    )
    human_lost: str = _parameter(
        "stop", "When topic 'human' is silent for human_timeout: 'stop', or 'nobody' is there."
    )
    scan_timeout: float = _parameter(0.0, "Oldest scan, s; 0: a control period of the policy.")
    odom_timeout: float = _parameter(0.0, "Oldest odometry, s; 0: a control period of the policy.")
    human_timeout: float = _parameter(
        0.0, "Oldest word of the human, s; 0: a control period of the policy."
    )
    clock_timeout: float = _parameter(1.0, "With use_sim_time: wall time without /clock, s.")
    lidar_mount: tuple[float, ...] = _parameter(
        (0.0, 0.0, 0.0), "x, y (m) and yaw (rad) of the lidar in base_frame_id, without tf2."
    )
    robot: tuple[float, ...] = _parameter(
        (0.0,) * 3,
        "For a policy that reads which robot it drives: radius (m), top speed (m/s) and top turn rate "
        "(rad/s); behind them may stand the lidar's view (rad), range (m) and distance ahead of the rotation "
        "centre (m), where less than it has is to count. All 0 for other policies.",
    )
    use_tf: bool = _parameter(
        True, "Where tf2_ros is installed: mount of the lidar, goals and humans in other frames."
    )
    goal_radius: float = _parameter(
        0.0, "Distance at which the goal is reached, m; 0: the policy's."
    )
    max_speed: float = _parameter(0.0, "Lower than the policy's, m/s; 0: the policy's.")
    max_turn_rate: float = _parameter(0.0, "Lower than the policy's, rad/s; 0: the policy's.")
    publish_rate: float = _parameter(50.0, "Commands and looks at the inputs a second, Hz.")
    enable_stamped_cmd_vel: bool = _parameter(False, "cmd_vel is a TwistStamped, not a Twist.")
    autostart: bool = _parameter(False, "Configure and activate without a lifecycle manager.")

    def __post_init__(self) -> None:
        for name in ("base_frame_id", "odom_frame_id"):
            if not getattr(self, name):
                raise self._refused(name, "the name of a frame")
        if self.human_message not in HUMAN_MESSAGES:
            raise self._refused("human_message", f"one of {', '.join(HUMAN_MESSAGES)}")
        if self.human_lost not in ("stop", "nobody"):
            raise self._refused("human_lost", "'stop' or 'nobody'")
        for name in ("scan_timeout", "odom_timeout", "human_timeout"):
            if not 0 <= getattr(self, name) <= 10:
                raise self._refused(name, "from 0 to 10 s")
        if not 0 < self.clock_timeout <= 10:
            raise self._refused("clock_timeout", "above 0 and at most 10 s")
        for name in ("goal_radius", "max_speed", "max_turn_rate"):
            if not 0 <= getattr(self, name) < math.inf:
                raise self._refused(name, "0 or a positive number")
        if len(self.lidar_mount) != 3 or not all(map(math.isfinite, self.lidar_mount)):
            raise self._refused("lidar_mount", "x, y (m) and yaw (rad), three finite numbers")
        if len(self.robot) not in (3, 6) or not all(map(math.isfinite, self.robot)):
            raise self._refused("robot", "three finite numbers, or six")
        if any(self.robot) and min(self.robot[:5]) < 1e-3:
            raise self._refused("robot", "numbers with radius, limits, view and range above 0")
        if not 5 <= self.publish_rate <= 200:
            raise self._refused("publish_rate", "from 5 to 200 Hz")

    def _refused(self, name: str, allowed: str) -> ValueError:
        return ValueError(f"{name} must be {allowed}, got {getattr(self, name)!r}.")


def descriptions() -> dict[str, tuple[Any, str]]:
    """Default and description of every parameter.

    Example:
        >>> descriptions()["base_frame_id"]
        ('base_link', 'Frame of the robot: rotation centre, x ahead.')
    """
    return {
        field.name: (field.default, field.metadata["description"])
        for field in dataclasses.fields(Settings)
    }
