"""The simulation of a clone as a robot: for trying the node without one.

It needs ``envs``, which no wheel carries: run it in a clone with ``.[sim]`` installed.
"""

from __future__ import annotations

import math
import time
from typing import Any, ClassVar

import numpy as np
import rclpy
from geometry_msgs.msg import Pose, PoseArray, PoseStamped, Quaternion, Twist, TwistStamped
from nav_msgs.msg import Odometry
from rclpy.clock import Clock, ClockType
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import QoSProfile, qos_profile_sensor_data
from rclpy.time import Time
from rosgraph_msgs.msg import Clock as ClockMessage
from sensor_msgs.msg import LaserScan
from torchrl.envs.utils import step_mdp

from envs import NavigationEnv
from envs.policy_env import lidar_geometry


class _Often(NavigationEnv):
    """Sensors and commands four times as often as the policy decides."""

    CONTROL_PERIOD: ClassVar[float] = 0.05


class SimulatedRobot(Node):
    """Publishes ``scan``, ``odom``, ``human`` and ``goal_pose``, and drives as ``cmd_vel`` says.

    Like a real base it stands when commands stay away, and like one it has no idea of policies.

    Parameters of ROS:

    - ``scene``, ``seed``, ``robot``: see :class:`envs.NavigationEnv`.
    - ``cmd_vel_timeout``: age at which a command is too old, s.
    - ``enable_stamped_cmd_vel``: ``cmd_vel`` is a ``TwistStamped``.
    - ``real_time_factor``: other than 1 it publishes ``/clock``; run the node with ``use_sim_time``.
    - ``human_message``: ``geometry_msgs/msg/PoseStamped`` or ``geometry_msgs/msg/PoseArray``.
    - ``next_scene``: whether another scene follows at the end of an episode, with its goal.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("simulated_robot", **kwargs)
        defaults = {
            "scene": "static",
            "seed": 0,
            "robot": "turtlebot2",
            "cmd_vel_timeout": 0.08,
            "enable_stamped_cmd_vel": False,
            "real_time_factor": 1.0,
            "human_message": "geometry_msgs/msg/PoseStamped",
            "next_scene": True,
        }
        self._given = given = {
            name: self.declare_parameter(name, value).value for name, value in defaults.items()
        }
        self.env = _Often(
            num_envs=1,
            scene=given["scene"],
            robot=given["robot"],
            seed=given["seed"],
            max_episode_steps=1200,
            num_threads=1,
        )
        self._lidar = lidar_geometry(self.env)
        self.period = self.env.CONTROL_PERIOD
        self.simulated_clock = given["real_time_factor"] != 1.0
        self._wall, self._now = Clock(clock_type=ClockType.SYSTEM_TIME), 10.0
        self.command, self.heard = (0.0, 0.0), -math.inf
        stamped = given["enable_stamped_cmd_vel"]
        kind, take = (TwistStamped, self._take_stamped) if stamped else (Twist, self.take_command)
        self.create_subscription(kind, "cmd_vel", take, QoSProfile(depth=1))
        array = given["human_message"].endswith("PoseArray")
        sensors = qos_profile_sensor_data
        self._scans = self.create_publisher(LaserScan, "scan", sensors)
        self._odometry = self.create_publisher(Odometry, "odom", sensors)
        self._humans = self.create_publisher(PoseArray if array else PoseStamped, "human", sensors)
        self._goals = self.create_publisher(PoseStamped, "goal_pose", QoSProfile(depth=1))
        if self.simulated_clock:
            self._clock = self.create_publisher(ClockMessage, "/clock", sensors)
        self.begin()

    # --- the simulation --------------------------------------------------------------------------

    def begin(self) -> None:
        """Another scene, with another goal."""
        self.state = self.env.reset()
        self.velocity = (0.0, 0.0)

    @property
    def now(self) -> float:
        """Seconds on the robot's clock."""
        return self._now if self.simulated_clock else self._wall.now().nanoseconds * 1e-9

    @property
    def pose(self) -> np.ndarray:
        """x, y (m) and heading (rad)."""
        return self.state["pose"][0].numpy()

    @property
    def ended(self) -> bool:
        """Whether the episode is over: at the goal, in a collision or after a minute."""
        return bool(self.state["done"])

    @property
    def succeeded(self) -> bool:
        """Whether the robot is at the goal."""
        return bool(self.state["success"])

    def advance(self) -> None:
        """One step of 0.05 s, with the last command if it is not too old."""
        self._now += self.period
        fresh = self.now - self.heard <= self._given["cmd_vel_timeout"]
        command = self.command if fresh else (0.0, 0.0)
        if self.ended:
            self.velocity = (0.0, 0.0)
        else:
            before = self.pose.copy()
            self.state["action"] = self.state["goal"].new_tensor([command])
            self.state = step_mdp(self.env.step(self.state))
            moved = self.pose - before
            turned = math.remainder(moved[2], 2 * math.pi)
            self.velocity = math.hypot(*moved[:2]) / self.period, turned / self.period
        self.publish()

    def take_command(self, twist: Twist) -> None:
        """What the base is to do from now on."""
        self.command, self.heard = (twist.linear.x, twist.angular.z), self.now

    def _take_stamped(self, message: TwistStamped) -> None:
        self.take_command(message.twist)

    # --- messages --------------------------------------------------------------------------------

    def publish(self) -> None:
        """What the sensors tell at this time."""
        stamp = Time(nanoseconds=round(self.now * 1e9)).to_msg()
        for publisher, message in (
            (self._odometry, self.odometry()),
            (self._humans, self.human()),
            (self._scans, self.scan()),
        ):
            if message is not None:
                if not message.header.stamp.sec:
                    message.header.stamp = stamp
                publisher.publish(message)
        if self.simulated_clock:
            # Last: what is decided at this time rests on what is sensed at this time.
            self._clock.publish(ClockMessage(clock=stamp))

    @property
    def listeners(self) -> int:
        """How many nodes wait for a goal."""
        return self._goals.get_subscription_count()

    def send_goal(self) -> None:
        """The goal of the scene, to the policy."""
        message = PoseStamped()
        message.header.frame_id = "odom"
        goal = self.state["scene", "goal"][0]
        message.pose.position.x, message.pose.position.y = map(float, goal)
        message.pose.orientation.w = 1.0
        self._goals.publish(message)

    def scan(self) -> LaserScan | None:
        """Ranges around the robot; at and above ``range_max`` is free."""
        lidar, message = self._lidar, LaserScan()
        message.header.frame_id = "base_scan"
        message.angle_min, message.angle_increment = lidar.first_angle, lidar.increment
        message.angle_max = lidar.first_angle + (lidar.num_beams - 1) * lidar.increment
        message.range_min, message.range_max = lidar.range_min, lidar.range_max
        message.ranges = self.state["scan"][0].tolist()
        return message

    def odometry(self) -> Odometry | None:
        """Where the robot is, without drift."""
        message = Odometry(child_frame_id="base_link")
        message.header.frame_id = "odom"
        message.pose.pose = _pose(*self.pose)
        message.twist.twist.linear.x, message.twist.twist.angular.z = self.velocity
        return message

    def human(self) -> PoseStamped | PoseArray | None:
        """Where the person is, as a tracker tells it."""
        pose = _pose(*self.state["human_pose"][0].tolist())
        if self._given["human_message"].endswith("PoseArray"):
            message = PoseArray(poses=[pose])
        else:
            message = PoseStamped(pose=pose)
        message.header.frame_id = "odom"
        return message

    def close(self) -> None:
        """Leave simulation and topics."""
        self.env.close()
        self.destroy_node()


def _pose(x: float, y: float, yaw: float) -> Pose:
    pose = Pose(orientation=Quaternion(z=math.sin(yaw / 2), w=math.cos(yaw / 2)))
    pose.position.x, pose.position.y = float(x), float(y)
    return pose


def main(args: list[str] | None = None) -> None:
    """Drive through one scene after the other, in real time, until interrupted."""
    rclpy.init(args=args)
    robot = SimulatedRobot()
    factor = robot.get_parameter("real_time_factor").value
    due, steps, told, stood = time.monotonic(), 0, 0, 0
    try:
        while rclpy.ok():
            due += robot.period / factor
            while (left := due - time.monotonic()) > 0:
                rclpy.spin_once(robot, timeout_sec=left)
            robot.advance()
            steps += 1
            if robot.ended and robot.get_parameter("next_scene").value:
                if not stood:
                    what = "goal reached" if robot.succeeded else "episode over"
                    robot.get_logger().info(f"{what} after {steps * robot.period:.1f} s")
                stood += 1
                if stood < 20:  # for a second whoever drives it sees that it has arrived
                    continue
                robot.begin()
                steps = told = stood = 0
            if steps >= 20:  # whoever comes later is told, too
                if robot.listeners > told:
                    robot.send_goal()
                told = robot.listeners
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        robot.close()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
