"""What a robot runs: from a scan to a command, without a simulator, and when to stop."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence, Set
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from torchrl_morl.arguments import is_number

from .entries import one_line
from .lidar import LidarGeometry
from .policy import Policy

__all__ = ["Command", "PolicyRunner", "Reason"]

Reason = Literal["drive", "goal reached", "clock", "stale", "no scan", "no goal", "refused"]

_FASTEST_HUMAN = 3.0
"""m/s. Two positions further apart are not those of one person."""

_FORGET_HUMAN = 5
"""Periods after which a human who comes back is seen for the first time."""


@dataclasses.dataclass(frozen=True)
class Command:
    """What the base is told.

    Args:
        speed: forward, m/s.
        turn_rate: counter-clockwise, rad/s.
        reason: ``"drive"``, or why the robot stops: see :class:`PolicyRunner`.
        detail: the same for a person to read; empty while driving.
        valid_until: on the clock of ``time``, seconds. A base that has got no other command by then
            must stop on its own: nothing here runs if the process hangs.
    """

    speed: float
    turn_rate: float
    reason: Reason
    detail: str
    valid_until: float


class PolicyRunner:
    """Drives a robot with a policy: one :meth:`step` a control period.

    It stops, with speed and turn rate 0, for these reasons:

    =================  =================================================================================
    reason             when
    =================  =================================================================================
    ``goal reached``   the goal is within ``goal_radius``
    ``clock``          ``time`` is not later than at the last step, or not a number, or ``stamp`` is later
                       than ``time`` by more than ``timeout``
    ``stale``          ``stamp`` is older than ``timeout``
    ``no scan``        the scan is ``None``, or has no valid beam
    ``no goal``        the goal is ``None``
    ``refused``        an input is not finite, of another shape or negative; the human is at 0 m; the
                       preference is off the simplex; the policy's own output is not finite
    =================  =================================================================================

    Otherwise it drives, and what the policy was not trained with reads as the nearest thing that it
    knows: a goal or human beyond the trained distances as the furthest of those; nobody as
    ``sensing.nobody``; a sector without a valid beam as ``sensing.unknown_range``. A sector is unknown
    also where something is nearer than the lidar's ``range_min``: it is no safety function, and a
    bumper or a safety lidar stays necessary.

    Args:
        policy: from :func:`load_policy`.

    Keyword Args:
        lidar: of the robot.
        goal_radius: distance at which the goal is reached, metres; that of the training if ``None``.
        timeout: age at which an input is too old, seconds; one period if ``None``.
        robot: which robot it is, six numbers as of :meth:`Policy.act`, for policies that read it.
        max_speed: of the robot, m/s, if lower than the policy's.
        max_turn_rate: likewise, rad/s. Speed and turn rate are lowered together, so that the robot
            follows the same arc, more slowly.

    Raises:
        ValueError: for limits that are not positive, a lidar too coarse for the policy's sectors, or a
            policy whose file does not tell what it senses.

    Example:
        In a clone ``load_policy("recipes/policies/navigation")`` is a trained one.

        >>> import numpy as np
        >>> from torchrl_morl.deploy import LidarGeometry, PolicyRunner
        >>> from torchrl_morl.testing import untrained_policy
        >>> lidar = LidarGeometry(-np.pi, np.pi / 180, 360, range_min=0.12, range_max=3.5)
        >>> policy = untrained_policy()
        >>> runner = PolicyRunner(policy, lidar=lidar)
        >>> scan = np.full(360, np.inf)
        >>> preference = (0.0, 0.5, 0.5)  # demo, distance, efficiency
        >>> command = runner.step(
        ...     scan, goal=(3.0, 0.1), preference=preference, stamp=0.0, time=0.05
        ... )
        >>> command.reason, command.speed > 0.1
        ('drive', True)
        >>> command = runner.step(
        ...     scan, goal=(3.0, 0.1), preference=preference, stamp=0.0, time=0.25
        ... )
        >>> command.reason, command.speed, command.detail
        ('stale', 0.0, 'the inputs are 0.25 s old, at most 0.2 s are allowed')
    """

    def __init__(
        self,
        policy: Policy,
        *,
        lidar: LidarGeometry,
        goal_radius: float | None = None,
        timeout: float | None = None,
        robot: Sequence[float] | None = None,
        max_speed: float | None = None,
        max_turn_rate: float | None = None,
    ) -> None:
        if not isinstance(policy, Policy):
            raise ValueError(f"policy must be a Policy, from load_policy, got {policy!r}.")
        if not isinstance(lidar, LidarGeometry):
            raise ValueError(f"lidar must be a LidarGeometry, got {lidar!r}.")
        if policy.sensing is None:
            raise ValueError("the file of this policy does not tell what it senses.")
        lidar.check(policy.sensing)
        if policy.sensing.observe_robot != (robot is not None):
            needs = "needs robot=" if robot is None else "does not read robot="
            raise ValueError(f"this policy {needs}: radius, limits and lidar of the robot.")
        self.robot = robot if robot is None else _numbers("robot", robot, "six numbers", 6)
        # Of such a policy, ranges are those of the lidar where it is.
        self._origin = policy.sensing.lidar_origin if robot is None else (self.robot[5], 0.0)
        self.policy, self.lidar = policy, lidar
        limits = policy.limits
        self.goal_radius = policy.sensing.goal_range[0] if goal_radius is None else goal_radius
        self.timeout = policy.period if timeout is None else timeout
        self.max_speed = max(map(abs, limits.speed)) if max_speed is None else max_speed
        self.max_turn_rate = (
            max(map(abs, limits.turn_rate)) if max_turn_rate is None else max_turn_rate
        )
        for name in ("goal_radius", "timeout", "max_speed", "max_turn_rate"):
            value = getattr(self, name)
            if not (is_number(value) and value > 0):
                raise ValueError(f"{name} must be finite and positive, got {value!r}.")
        self._time: float | None = None
        self._human: tuple[float, float, float] | None = None
        self._velocity = (0.0, 0.0)

    def step(
        self,
        ranges: ArrayLike | None,
        *,
        goal: Sequence[float] | None,
        preference: Sequence[float],
        stamp: float,
        time: float,
        human: Sequence[float] | None = None,
        human_velocity: Sequence[float] | None = None,
        odometry: Sequence[float] | None = None,
    ) -> Command:
        """Command for the next control period. It raises for nothing that it is given: it stops.

        Args:
            ranges: the scan ``[num_beams]``, metres.

        Keyword Args:
            goal: distance (m) and bearing (rad) from the robot.
            preference: weights of the tunable objectives, on the simplex.
            stamp: when the oldest input was measured, seconds.
            time: now, on the same clock.
            human: distance (m) of the nearest person's centre, and bearing (rad); ``None`` if there
                is nobody.
            human_velocity: of that person over the ground, ahead and to the left of the robot, m/s.
                Only for policies that read it.
            odometry: instead of ``human_velocity``: where the robot is in any fixed frame, x and y
                (m) and heading (rad). The velocity is then that between two positions of the human;
                at first sight it is 0.
        """
        last, self._time = self._time, time if is_number(time) else self._time
        if not is_number(time) or not is_number(stamp):
            given = f"{_shown(time)} and {_shown(stamp)}"
            return self._stop("clock", f"time and stamp must be finite numbers, got {given}")
        if last is not None and time <= last:
            return self._stop("clock", f"time is {time} s, at the last step it was {last} s")
        age = time - stamp
        if age < -self.timeout:
            return self._stop("clock", f"stamp is {-age:.2f} s later than time: two clocks")
        if age > self.timeout + 1e-9:
            allowed = f"at most {self.timeout:g} s are allowed"
            return self._stop("stale", f"the inputs are {age:.2f} s old, {allowed}")
        if ranges is None:
            return self._stop("no scan", "the scan is None")
        if goal is None:
            return self._stop("no goal", "the goal is None")
        sensing = self.policy.sensing
        try:
            lidar = self.lidar.sectors(ranges, sensing.num_sectors, sensing.max_range, self._origin)
            unknown = np.isnan(lidar)
            if lidar.ndim != 1:
                raise ValueError(f"one scan at a time, got {len(lidar)}")
            goal, human = _polar("goal", goal), None if human is None else _polar("human", human)
            if human is not None and human[0] == 0:
                raise ValueError("the human is at 0 m: for nobody pass human=None")
            if human is not None and human_velocity is None and odometry is not None:
                human_velocity = self._velocity_of(human, odometry, stamp)
            command = self.policy.act(
                preference=preference,
                lidar=np.where(unknown, sensing.unknown_range, lidar),
                goal=goal,
                human=human,
                human_velocity=None if human is None else human_velocity,
                robot=self.robot,
            )
        except ValueError as error:
            return self._stop("refused", one_line(error).rstrip("."))
        except Exception as error:
            # Whatever objects are given may raise whatever they like: the robot stops.
            return self._stop("refused", f"{type(error).__name__}: {one_line(error)}".rstrip("."))
        if command.shape != (2,):
            return self._stop("refused", f"one preference at a time, got {len(command)}")
        if unknown.all():
            return self._stop("no scan", "the scan has no valid beam")
        if goal[0] <= self.goal_radius:
            return self._stop("goal reached", f"the goal is {goal[0]:.2f} m away")
        speed, turn_rate = map(float, command)
        share = min(
            1.0,
            self.max_speed / max(abs(speed), 1e-9),
            self.max_turn_rate / max(abs(turn_rate), 1e-9),
        )
        return Command(speed * share, turn_rate * share, "drive", "", time + self.timeout)

    def _velocity_of(
        self, human: tuple[float, float], odometry: Sequence[float], stamp: float
    ) -> tuple[float, float]:
        """Of the human since the last step, along the axes of the robot."""
        x, y, heading = _numbers("odometry", odometry, "x, y and heading", 3)
        distance, bearing = human
        x += distance * math.cos(heading + bearing)
        y += distance * math.sin(heading + bearing)
        last, self._human = self._human, (stamp, x, y)
        since = stamp - last[0] if last else math.inf
        if since <= 0:  # the same inputs again
            self._human = last
        elif since > _FORGET_HUMAN * self.policy.period:
            self._velocity = (0.0, 0.0)
        else:
            velocity = (x - last[1]) / since, (y - last[2]) / since
            self._velocity = velocity if math.hypot(*velocity) <= _FASTEST_HUMAN else (0.0, 0.0)
        east, north = self._velocity
        cos, sin = math.cos(heading), math.sin(heading)
        return cos * east + sin * north, cos * north - sin * east

    def _stop(self, reason: Reason, detail: str) -> Command:
        until = math.inf if self._time is None else self._time + self.timeout
        return Command(0.0, 0.0, reason, detail, until)


def _shown(value: object) -> str:
    try:
        return one_line(repr(value))
    except Exception:  # whatever an object does instead of telling what it is
        return f"a {type(value).__name__}"


def _numbers(name: str, value: Sequence[float], what: str, count: int) -> tuple[float, ...]:
    # A set or a mapping has no order that anybody meant.
    unordered = isinstance(value, Set | Mapping)
    try:
        numbers = () if unordered else tuple(float(entry) for entry in value)
    except (TypeError, ValueError, OverflowError):
        numbers = ()
    if len(numbers) != count:
        raise ValueError(f"{name} must be {what}, got {_shown(value)}")
    if not all(map(math.isfinite, numbers)):
        raise ValueError(f"{name} must be finite, got {numbers}")
    return numbers


def _polar(name: str, value: Sequence[float]) -> tuple[float, float]:
    distance, bearing = _numbers(name, value, "a distance and a bearing", 2)
    if distance < 0:
        raise ValueError(
            f"{name} must be finite, with a distance of at least 0, got {(distance, bearing)}"
        )
    return distance, bearing
