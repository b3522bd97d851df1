"""Can the robot drive a recorded trajectory, and if not, why not?"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from torch import Tensor

from torchrl_morl.geometry import point_box_distance

from ..navigation import NavigationEnv
from ..robots import TURTLEBOT2, Robot, get_robot
from ..scenes import HUMAN_RADIUS
from .conventions import heading_convention, unit_of_time
from .recordings import Recording
from .report import Reason, enough
from .timed_path import TimedPath, resample, velocities

# How far a recorded goal may wander within a trajectory, metres.
_GOAL_DRIFT = 0.01
# A value this many times over its limit is of another unit rather than of another robot.
_ABSURD = 10.0
# Beyond them sums and squares are no numbers: metres and radians, and seconds, even where they are nanoseconds.
_FARTHEST, _LATEST = 1e12, 1e24
# Two days: nobody has driven so far, and so many points would fill the memory.
_MOST_STEPS = 1_000_000


@dataclasses.dataclass(frozen=True)
class Tolerances:
    """How far a recording may exceed what the robot can do; recorded poses are noisy.

    Args:
        speed: above the robot's largest speed, m/s.
        backwards: of driving backwards, m/s.
        turn_rate: above the robot's largest turn rate, rad/s.
        slip: sideways, m/s.
        gap: longest time between two points, s: what lies between them is a guess.

    Raises:
        ValueError: for a tolerance that is negative or not finite, or a gap that is not positive.
    """

    speed: float = 0.05
    backwards: float = 0.05
    turn_rate: float = 0.2
    slip: float = 0.1
    gap: float = 0.5

    def __post_init__(self) -> None:
        for name, value in dataclasses.asdict(self).items():
            if not (math.isfinite(value) and value >= 0):
                raise ValueError(f"The {name} tolerance must be finite and not negative: {value}.")
        if not self.gap > 0:
            raise ValueError(f"The gap tolerance must be positive, in seconds: {self.gap}.")


def check_limits(goal_radius: float, max_steps: int) -> None:
    """Whether episodes of this kind exist.

    Raises:
        ValueError: for a goal radius or a number of steps that is not positive.
    """
    if not (math.isfinite(goal_radius) and goal_radius > 0):
        raise ValueError(f"goal_radius must be positive and finite, in metres: {goal_radius}.")
    if max_steps != int(max_steps) or max_steps < 1:
        raise ValueError(f"max_steps must be a whole number of control steps from 1: {max_steps}.")


def check(
    recording: Recording,
    robot: str | Robot = TURTLEBOT2,
    *,
    goal_radius: float = 0.3,
    max_steps: int = 300,
    tolerances: Tolerances | None = None,
) -> tuple[TimedPath | None, list[Reason]]:
    """Turn a recording into a path that ends at the goal, or say why the robot cannot drive it.

    Args:
        recording: as read from its file.
        robot: what :func:`envs.get_robot` takes.

    Keyword Args:
        goal_radius: distance from the goal at which it is reached, metres.
        max_steps: longest episode, control steps.
        tolerances: default :class:`Tolerances`.

    Returns:
        The path up to the first point at the goal and an empty list; or ``None`` and the reasons.

    Raises:
        ValueError: for an unknown robot, or a goal radius or a number of steps that is not positive.
    """
    robot, tolerances = get_robot(robot), tolerances or Tolerances()
    check_limits(goal_radius, max_steps)
    reasons = _unusable(recording, tolerances)
    if reasons:
        return None, reasons
    period = NavigationEnv.CONTROL_PERIOD
    duration = float(recording.time[-1] - recording.time[0])
    if duration > _MOST_STEPS * period:
        what = f"longer than {_MOST_STEPS:,} control steps"
        text = f"lasts {duration:g} s, {what}"
        return None, [Reason(text, what, "times in seconds?", duration, "s")]
    path = resample(recording)
    if path is None:
        text = "has no heading and never moves, so that none can be derived"
        return None, [Reason(text, "without heading that never move")]
    if len(path.time) < 2:
        what = f"shorter than a control step of {period} s"
        return None, [Reason(f"is {what}", what)]
    distance = (path.pose[:, :2] - path.goal).norm(dim=-1)
    reached = distance <= goal_radius
    if reached[0]:
        what = f"within {goal_radius:g} m of the goal"
        return None, [Reason(f"starts {what}", f"that start {what}", "--goal-radius")]
    if reached.any():
        # An episode ends at the goal: what comes after is none of it.
        path = path.first(int(reached.int().argmax()) + 1)
    else:
        nearest = distance.min().item()
        near = nearest < 1.0
        reasons.append(
            Reason(
                f"never comes within {goal_radius:g} m of the goal, {nearest:.2f} m at best",
                f"that never come within {goal_radius:g} m of the goal",
                f"--goal-radius {enough(nearest)}" if near else "is it the goal of this drive?",
                nearest,
                "m away at best",
            )
        )
    steps = len(path.time) - 1
    if steps > max_steps:
        reasons.append(
            Reason(
                f"takes {steps} control steps, an episode has {max_steps}",
                f"longer than {max_steps} control steps of {period} s",
                f"--max-steps {steps}",
                steps,
                "steps",
            )
        )
    faults = _motion_faults(path, robot, tolerances)
    wrong = {kind for kind in faults if kind != "speed"}
    if wrong and recording.heading is not None:

        def fits(heading: np.ndarray) -> bool:
            other = resample(dataclasses.replace(recording, heading=heading))
            others = _motion_faults(other.first(len(path.time)), robot, tolerances)
            return others.keys() <= {"speed"}

        convention = heading_convention(recording, fits)
        if convention:
            # What the heading's convention brings about are no faults of their own.
            faults = {kind: faults[kind] for kind in faults if kind not in wrong}
            reasons.append(convention)
    reasons += [*faults.values(), *_contacts(path, robot)]
    return (None, reasons) if reasons else (path, [])


def _unusable(recording: Recording, tolerances: Tolerances) -> list[Reason]:
    """What rules out resampling."""
    if recording.faults:
        return [Reason(fault, "with parts that cannot be read") for fault in recording.faults]
    count = len(recording.time)
    if count < 2:
        return [Reason(f"has {count} point(s), fewer than 2", "of fewer than 2 points")]
    reasons = []
    for name, values in recording.columns().items():
        bad = ~(np.abs(values) <= (_LATEST if name == "time" else _FARTHEST))
        if bad.any():
            more = f" and {bad.sum() - 1} more" if bad.sum() > 1 else ""
            first = values[bad.argmax()]
            what = f"beyond all sense, {first:g}," if np.isfinite(first) else "not finite"
            text = f"column {name} is {what} at {recording.place(bad.argmax())}{more}"
            reasons.append(Reason(text, "with numbers that are not finite"))
    if reasons:
        return reasons
    reasons = _time_faults(recording, tolerances)
    drift = np.linalg.norm(recording.goal - recording.goal[-1], axis=-1).max()
    if drift > _GOAL_DRIFT:
        moves = np.linalg.norm(np.diff(recording.goal, axis=0), axis=-1)
        place = recording.place(int(moves.argmax()) + 1)
        text = f"the goal moves by {drift:.2f} m, most at {place}: a trajectory has one goal"
        hint = "one name for each goal"
        reasons.append(Reason(text, "whose goal moves", hint, float(drift), "m"))
    return reasons


def _time_faults(recording: Recording, tolerances: Tolerances) -> list[Reason]:
    time, steps = recording.time, np.diff(recording.time)
    if (steps <= 0).any():
        index = int((steps <= 0).argmax()) + 1
        place = recording.place(index)
        # Times that are equal in the file may differ by rounding once an epoch is subtracted.
        if steps[index - 1] < -1e-9:
            text = f"time goes back from {time[index - 1]:g} to {time[index]:g} s at {place}"
            hint = "two drives under one name, points out of order, or padding with zeros?"
            return [Reason(text, "whose time goes back", hint)]
        text = f"time stands still at {place}, {time[index]:.12g} s"
        hint = "one point for each time"
        # float32 has steps of 0.06 s from 10^6 s on, of 128 s at an epoch's seconds.
        if np.abs(time).max() >= 1e6 or (time == time.round()).all():
            hint = "whole seconds, or an epoch's in float32? Subtract the first time, keep decimals"
        return [Reason(text, "whose time stands still", hint)]
    if steps.max() <= tolerances.gap + 1e-9:
        return []
    place = recording.place(int(steps.argmax()) + 1)
    text = f"time jumps by {steps.max():.2f} s at {place}, over {tolerances.gap:g} s"
    unit = unit_of_time(recording) if np.median(steps) > tolerances.gap else None
    if unit:
        what = f"{unit}? seconds are expected"
        return [
            Reason(
                f"{text}: {what}",
                f"with points too far apart in time: {what}",
                "",
                float(steps.max()),
                "s",
            )
        ]
    return [
        Reason(
            text,
            f"with more than {tolerances.gap:g} s between points",
            f"--gap-tolerance {enough(steps.max())}",
            float(steps.max()),
            "s",
        )
    ]


def _motion_faults(path: TimedPath, robot: Robot, tolerances: Tolerances) -> dict[str, Reason]:
    """Reasons by the tolerance that they exceed."""
    speed, turn, slip = velocities(path.pose[:-1], path.pose[1:])
    top, rate = robot.max_speed, robot.max_turn_rate
    faster = f"faster than {robot.name}'s {top:g} m/s"
    turning = f"that turn faster than {robot.name}'s {rate:.3g} rad/s"
    limits: tuple[tuple[str, str, Tensor, float, str, str, str], ...] = (
        ("speed", "drives at", speed, top, "m/s", faster, "--robot, or"),
        ("backwards", "drives backwards at", -speed, 0.0, "m/s", "that drive backwards", "does heading point to the front? Or"),
        ("turn_rate", "turns at", turn.abs(), rate, "rad/s", turning, "smooth a noisy heading; --robot, or"),
        ("slip", "slips sideways at", slip.abs(), 0.0, "m/s", "that slip sideways", "smooth a noisy track; is x, y the centre of rotation? Or"),
    )  # fmt: skip
    faults = {}
    for name, what, value, limit, unit, kind, hint in limits:
        tolerance = getattr(tolerances, name)
        # 1e-6: rounding in a file's decimals is not a fault.
        count = int((value > limit + tolerance + 1e-6).sum())
        if not count:
            continue
        worst = int(value.argmax())
        most = value[worst].item()
        hint = f"{hint} --{name.replace('_', '-')}-tolerance {enough(most - limit)}"
        if name == "speed" and most > _ABSURD * limit:
            usual = value.median().item() > _ABSURD * limit
            hint = "positions in metres, times in seconds?" if usual else "does the position jump?"
        text = (
            f"{what} {most:.2f} {unit} at {path.time[worst].item():.2f} s, over "
            f"{limit:.2f} + {tolerance:.2f} {unit} in {count} step(s)"
        )
        faults[name] = Reason(text, kind, hint, most, unit)
    return faults


def _contacts(path: TimedPath, robot: Robot) -> list[Reason]:
    """Contacts by the rule of :class:`NavigationEnv`, at the points of the path."""
    position = path.pose[:, :2]
    gap = (position - path.human).norm(dim=-1) - robot.radius - HUMAN_RADIUS
    gaps = [("the human", gap, "--robot with a smaller radius")]
    if len(path.boxes):
        distance = point_box_distance(position[:, None], path.boxes).amin(-1) - robot.radius
        gaps.append(("a box", distance, "--robot; are the sizes of the boxes half sizes?"))
    return [
        Reason(
            f"touches {what} at {path.time[int((gap <= 0).int().argmax())].item():.2f} s",
            f"that touch {what}",
            hint,
        )
        for what, gap, hint in gaps
        if (gap <= 0).any()
    ]
