"""The lifecycle node: topics and parameters in, velocities and diagnostics out."""

from __future__ import annotations

import importlib
import signal
import sys
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, Twist, TwistStamped
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, qos_profile_sensor_data
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import LaserScan
from std_msgs.msg import Float64MultiArray

from torchrl_morl.deploy import load_policy

from .driver import Decision, Driver
from .inputs import Fault
from .publishing import WELL, diagnostics, velocity
from .settings import Settings, descriptions
from .transforms import has_tf2, listen
from .transitions import refuse_impossible

_SUCCESS, _FAILURE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE
_PREFERENCE = "Weights of the policy's tunable objectives; they sum to 1. May be set at any time."
_POINT = "Write every number with a point: 1.0, not 1."


class PolicyNode(LifecycleNode):
    """Drives a robot with a policy while it is active, and stands otherwise."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("policy_node", **kwargs)
        for name, (default, description) in descriptions().items():
            value = list(default) if isinstance(default, tuple) else default
            self.declare_parameter(name, value, ParameterDescriptor(description=description))
        self.declare_parameter(
            "preference",
            Parameter.Type.DOUBLE_ARRAY,
            ParameterDescriptor(description=_PREFERENCE),
        )
        self.add_on_set_parameters_callback(self._may_be_set)
        self.add_post_set_parameters_callback(self._were_set)
        # Of wall time: it looks after the other clock.
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._driver: Driver | None = None
        self._listener: Any = None
        self._active, self._others = False, 0
        self._parts: list[tuple[Any, Any]] = []
        refuse_impossible(self)

    # --- lifecycle -------------------------------------------------------------------------------

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Read the parameters and the policy, and make the topics."""
        try:
            self._settings = self._read_settings()
            self._kind = self._human_type()
            policy = load_policy(self._settings.policy)
            lookup = self._transforms()
            self._driver = Driver(policy, self._settings, self._preference(), lookup)
        except (ValueError, OSError) as error:
            self.get_logger().error(f"not configured: {error}")
            self._forget()
            return _FAILURE
        self._make_topics()
        space = policy.preference_space
        weights = dict(zip(space.tunable, self._driver.preference))
        self.get_logger().info(
            f"{self._settings.policy}: {policy.robot}, {policy.period:g} s a step, preference "
            + ", ".join(f"{name} {weight:.2f}" for name, weight in weights.items())
        )
        return _SUCCESS

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Drive to the goals that come from now on."""
        now = self._steady.now().nanoseconds
        self._stepped, self._ros_time, self._moved = None, None, now
        self._active, self._told = True, None
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stand, and forget the goal."""
        self._stand(Fault("inactive", "the node is not active"))
        self._driver.inputs.forget_goal()
        self._active = False
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Forget policy and topics."""
        self._forget()
        return _SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stand for good."""
        self.stop_now()
        self._forget()
        return _SUCCESS

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stand, and be configured anew."""
        self.stop_now()
        self._forget()
        return _SUCCESS

    def stop_now(self) -> None:
        """Send a zero velocity if the robot may be driving."""
        if self._active:
            self._stand(Fault("inactive", "the node shuts down"))
            self._active = False

    # --- parameters ------------------------------------------------------------------------------

    def _read_settings(self) -> Settings:
        given = {}
        for name, (default, _) in descriptions().items():
            value = self.get_parameter(name).value
            given[name] = tuple(value) if isinstance(default, tuple) else value
        if not given["policy"]:
            raise ValueError("policy must be the folder of a policy, got '': -p policy:=FOLDER.")
        return Settings(**given)

    def _preference(self) -> list[float]:
        parameter = self.get_parameter_or("preference")
        return [] if parameter.value is None else list(parameter.value)

    def _may_be_set(self, parameters: list[Parameter]) -> SetParametersResult:
        """Before anything is set: whether all of it makes sense now."""
        if self._driver is None:
            return SetParametersResult(successful=True)
        for parameter in parameters:
            if parameter.name in descriptions():
                reason = f"{parameter.name} is read when the node is configured: clean it up first"
                return SetParametersResult(successful=False, reason=reason)
            if parameter.name == "preference":
                try:
                    self._driver.checked(parameter.value or ())
                except ValueError as error:
                    return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _were_set(self, parameters: list[Parameter]) -> None:
        for parameter in parameters:
            if self._driver is not None and parameter.name == "preference":
                self._driver.preference = self._driver.checked(parameter.value)

    def _human_type(self) -> type | None:
        kind = self._settings.human_message
        if kind == "none":
            return None
        package, _, name = kind.split("/")
        try:
            return getattr(importlib.import_module(f"{package}.msg"), name)
        except ImportError as error:
            raise ValueError(
                f"human_message is {kind!r}, and {package} is not installed: apt install "
                f"ros-$ROS_DISTRO-{package.replace('_', '-')}, or another human_message."
            ) from error

    def _transforms(self) -> Any:
        if not self._settings.use_tf:
            return None
        if not has_tf2():
            frames = f"{self._settings.odom_frame_id!r} and {self._settings.base_frame_id!r}"
            self.get_logger().info(f"no tf2_ros: lidar_mount counts, and frames are {frames}")
            return None
        lookup, self._listener = listen(self)
        return lookup

    # --- topics ----------------------------------------------------------------------------------

    def _make_topics(self) -> None:
        inputs, sensors, once = self._driver.inputs, qos_profile_sensor_data, QoSProfile(depth=1)
        subscribed = [
            (LaserScan, "scan", self._take_scan, sensors),
            (Odometry, "odom", inputs.take_odometry, sensors),
            (PoseStamped, "goal_pose", self._take_goal, once),
            (Float64MultiArray, "preference", self._take_preference, once),
        ]
        if self._kind is not None:
            subscribed.append((self._kind, "human", inputs.take_people, sensors))
        for kind, topic, callback, qos in subscribed:
            made = self.create_subscription(kind, topic, callback, qos)
            self._parts.append((self.destroy_subscription, made))
        twist = TwistStamped if self._settings.enable_stamped_cmd_vel else Twist
        self._velocity = self.create_publisher(twist, "cmd_vel", once)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._parts += [(self.destroy_publisher, p) for p in (self._velocity, self._diagnostics)]
        for period, callback, clock in (
            (1.0 / self._settings.publish_rate, self._tick, self.get_clock()),
            (0.5, self._look_at_clock, self._steady),
            (1.0, self._tell, self._steady),
        ):
            self._parts.append(
                (self.destroy_timer, self.create_timer(period, callback, clock=clock))
            )

    def _forget(self) -> None:
        for destroy, part in self._parts:
            destroy(part)
        self._parts.clear()
        if self._listener is not None:
            self._listener.unregister()
        self._driver = self._listener = None

    def _take_scan(self, scan: LaserScan) -> None:
        self._driver.inputs.take_scan(scan)
        if self._active:
            # A scan that says nothing stops the robot at once, not at the next look.
            self._publish_if_changed(self._driver.watch(self._now()))

    def _take_goal(self, goal: PoseStamped) -> None:
        if not self._active:
            self.get_logger().warning("a goal is not taken: the node is not active")
            return
        self._driver.inputs.take_goal(goal)
        place = goal.pose.position
        self.get_logger().info(f"goal ({place.x:.2f}, {place.y:.2f}) in {goal.header.frame_id!r}")

    def _take_preference(self, message: Float64MultiArray) -> None:
        value = list(message.data)
        if value == list(self._driver.preference):
            return
        # Through the parameter: one place tells which preference holds.
        parameter = Parameter("preference", Parameter.Type.DOUBLE_ARRAY, value)
        (result,) = self.set_parameters([parameter])
        if not result.successful:
            self.get_logger().warning(f"{result.reason} The last one holds.")

    # --- time ------------------------------------------------------------------------------------

    def _now(self) -> float:
        return self.get_clock().now().nanoseconds * 1e-9

    def _tick(self) -> None:
        """Decide if a control period is over, else look; send the command either way."""
        if not self._active:
            return
        now, period = self._now(), self._driver.policy.period
        self._moved = self._steady.now().nanoseconds
        slack = 0.5 / self._settings.publish_rate
        due = self._stepped is None or not 0 <= now - self._stepped < period - slack
        try:
            decision = self._driver.step(now) if due else self._driver.watch(now)
        except Exception as error:  # whatever it is: the robot stands, and somebody is told
            fault = Fault("error", f"{type(error).__name__}: {error}".splitlines()[0])
            decision = self._driver.halt(fault)
        if due:
            self._stepped = now
        self._publish(decision)

    def _look_at_clock(self) -> None:
        """Stand if the clock does, which nothing that hangs on it would notice."""
        if not self._active:
            return
        still = (self._steady.now().nanoseconds - self._moved) * 1e-9
        if still > self._settings.clock_timeout:
            why = "use_sim_time is true: does anybody publish /clock?"
            if not self.get_parameter("use_sim_time").value:
                why = "the machine was busy"
            self._stand(Fault("clock", f"the ROS clock stands still for {still:.1f} s: {why}"))

    # --- out -------------------------------------------------------------------------------------

    def _stand(self, fault: Fault) -> None:
        self._publish(self._driver.halt(fault))

    def _publish_if_changed(self, decision: Decision) -> None:
        if decision.reason != self._told:
            self._publish(decision)

    def _publish(self, decision: Decision) -> None:
        stamp = self.get_clock().now().to_msg()
        self._velocity.publish(
            velocity(
                decision,
                stamp,
                self._settings.base_frame_id,
                stamped=self._settings.enable_stamped_cmd_vel,
            )
        )
        if decision.reason != self._told:
            self._told = decision.reason
            told = f"{decision.reason}: {decision.detail}".rstrip(": ")
            if decision.reason in WELL:
                self.get_logger().info(told)
            else:
                self.get_logger().warning(told)
            self._tell()

    def _tell(self) -> None:
        """Diagnostics: once a second, and at once when the reason changes."""
        driver, now = self._driver, self._now()
        weights = zip(driver.policy.preference_space.tunable, driver.preference)
        ages = {f"age of {name} (s)": now - stamp for name, stamp in driver.inputs.stamps.items()}
        values = {f"preference {name}": f"{weight:.3f}" for name, weight in weights}
        values |= {name: f"{age:.3f}" for name, age in ages.items()}
        values["others that publish cmd_vel"] = str(self._count_others())
        # Of several robots each one is told apart by its namespace.
        name = f"{self.get_fully_qualified_name().lstrip('/')}: policy"
        hardware = driver.policy.robot
        decision = driver.decision
        if not self._active:
            decision = Decision.stop(Fault("inactive", "the node is not active"))
        stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(diagnostics(name, hardware, decision, stamp, values))

    def _count_others(self) -> int:
        """Who else tells the base what to do; it is told when they come."""
        topic = self._velocity.topic_name
        others = max(0, self.count_publishers(topic) - 1)
        if others > self._others:
            self.get_logger().warning(
                f"others publish {topic} as well ({others}): the base gets both their commands and "
                "these. End them, or put a multiplexer between"
            )
        self._others = others
        return others


def main(args: list[str] | None = None) -> None:
    """Run the node until it is interrupted."""
    # With its own handlers rclpy would close the topics before the last zero velocity is sent.
    try:
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
        node, executor = PolicyNode(), SingleThreadedExecutor()
    except (ParameterException, RuntimeError) as error:  # of ROS: types, and what it cannot parse
        line = f"policy_node: error: {error}".splitlines()[0]
        sys.exit(f"{line}. {_POINT}" if "DOUBLE" in line or "same type" in line else line)
    executor.add_node(node)
    wanted = True

    def leave(*_: Any) -> None:
        nonlocal wanted
        wanted = False

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, leave)
    code = 0
    try:
        if node.get_parameter("autostart").value:
            started = node.trigger_configure() == _SUCCESS and node.trigger_activate() == _SUCCESS
            code = 0 if started else 1
            wanted = wanted and started
        while wanted and rclpy.ok():
            executor.spin_once(timeout_sec=0.1)
        node.stop_now()
    except ExternalShutdownException:
        pass
    except Exception:
        node.stop_now()  # whatever it is: the robot does not drive on until its base notices
        raise
    finally:
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown()
    sys.exit(code)


if __name__ == "__main__":
    main()
