"""From messages to commands, without ROS: when to drive, how, and why not."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

from torchrl_morl.deploy import Policy, PolicyRunner

from .frames import Lookup
from .geometry import Pose
from .inputs import Fault, Inputs
from .settings import Settings


@dataclasses.dataclass(frozen=True)
class Decision:
    """What the base is told, and why.

    Args:
        speed: forward, m/s.
        turn_rate: counter-clockwise, rad/s.
        reason: ``"drive"``, or why the robot stands.
        detail: the same for a person to read.
    """

    speed: float
    turn_rate: float
    reason: str
    detail: str = ""

    @classmethod
    def stop(cls, fault: Fault) -> Decision:
        """Stand, for this reason."""
        return cls(0.0, 0.0, *fault)


class Driver:
    """Decides once a control period, and looks in between whether that still holds.

    Args:
        policy: from :func:`torchrl_morl.deploy.load_policy`.
        settings: of the node.
        preference: ``[T]`` on the simplex; equal weights if it is empty.
        lookup: of tf2, or ``None``.

    Raises:
        ValueError: for a policy or a preference that cannot be driven with.
    """

    def __init__(
        self,
        policy: Policy,
        settings: Settings,
        preference: Sequence[float] = (),
        lookup: Lookup | None = None,
    ) -> None:
        if policy.sensing is None:
            raise ValueError(
                f"policy: {settings.policy} does not tell what it senses: save it again with sensing=."
            )
        if policy.sensing.observe_robot != any(settings.robot):
            allowed = (
                "radius (m), top speed (m/s) and top turn rate (rad/s)"
                if policy.sensing.observe_robot
                else "left out: this policy does not read which robot it drives"
            )
            raise ValueError(f"robot must be {allowed}, got {list(settings.robot)}.")
        self.policy, self.settings = policy, settings
        self.inputs = Inputs(settings, policy.period, lookup)
        count = policy.preference_space.num_tunable
        self.preference = self.checked(preference or [1.0 / count] * count)
        self._runner: PolicyRunner | None = None
        self.decision = Decision.stop(Fault("inactive", "has decided nothing yet"))

    def checked(self, preference: Sequence[float]) -> tuple[float, ...]:
        """A preference as it is used.

        Raises:
            ValueError: if it is off the simplex; the message says which objectives it weighs.
        """
        space = self.policy.preference_space
        values = tuple(map(float, preference))
        fits = len(values) == space.num_tunable and all(value >= 0 for value in values)
        if not fits or not math.isclose(sum(values), 1.0, abs_tol=1e-4):
            raise ValueError(
                f"preference must be {space.num_tunable} weights from 0 to 1 that sum to 1, for "
                f"{', '.join(space.tunable)}, got {list(values)}."
            )
        return values

    def step(self, now: float) -> Decision:
        """Decide for the next control period.

        Args:
            now: on the clock of the messages' stamps, seconds.
        """
        fault = self.inputs.fault(now)
        self.decision = Decision.stop(fault) if fault else self._drive(now)
        if self.decision.reason == "goal reached":
            self.inputs.arrived = True
        return self.decision

    def watch(self, now: float) -> Decision:
        """The decision, or a stop if what it rests on is gone. It never makes a robot drive."""
        if self.decision.reason == "drive":
            fault = self.inputs.fault(now)
            if fault:
                self.decision = Decision.stop(fault)
        return self.decision

    def halt(self, fault: Fault) -> Decision:
        """Stand until the next step."""
        self.decision = Decision.stop(fault)
        return self.decision

    def _drive(self, now: float) -> Decision:
        inputs, sensing = self.inputs, self.policy.sensing
        _, robot = inputs.frames.latest
        try:
            runner = self._ready()
        except ValueError as error:
            return Decision.stop(Fault("refused", str(error).rstrip(".")))
        try:
            goal = robot.polar(inputs.goal())
        except (ValueError, LookupError) as error:
            return Decision.stop(Fault("refused", f"goal: {error}".rstrip(".")))
        human, velocity = inputs.nearest(robot, now), None
        if human and sensing.observe_human_velocity and human.velocity:
            # From the fixed frame to ahead and left.
            velocity = Pose(0.0, 0.0, -robot.yaw).apply(human.velocity)
        command = runner.step(
            inputs.ranges,
            goal=goal,
            human=robot.polar(human.position) if human else None,
            human_velocity=velocity,
            odometry=robot if sensing.observe_human_velocity or sensing.observe_motion else None,
            preference=self.preference,
            stamp=inputs.oldest(now),
            time=now,
        )
        return Decision(command.speed, command.turn_rate, command.reason, command.detail)

    def _ready(self) -> PolicyRunner:
        """The runner with the lidar of the last scan."""
        inputs, settings = self.inputs, self.settings
        if self._runner is None:
            self._runner = PolicyRunner(
                self.policy,
                lidar=inputs.lidar,
                goal_radius=settings.goal_radius or None,
                timeout=max(inputs.timeouts.values()),
                robot=settings.robot if self.policy.sensing.observe_robot else None,
                max_speed=settings.max_speed or None,
                max_turn_rate=settings.max_turn_rate or None,
            )
        elif self._runner.lidar is not inputs.lidar:
            # Some drivers send a beam more or less; what the runner knows of the human stays.
            inputs.lidar.check(self.policy.sensing)
            self._runner.lidar = inputs.lidar
        return self._runner
