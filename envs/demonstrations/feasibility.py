"""Can the robot drive a recorded trajectory? Resampling, velocities and the reasons why not."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from torch import Tensor

from torchrl_morl.geometry import point_box_distance, wrap_angle

from ..navigation import NavigationEnv
from ..robots import TURTLEBOT2, Robot, get_robot
from ..scenes import HUMAN_RADIUS
from .recordings import Recording

# A motion shorter than this within a step has no reliable direction, metres.
_STILL = 0.01
# How far a recorded goal may wander within a trajectory, metres.
_GOAL_DRIFT = 0.01


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
        ValueError: for a negative tolerance or a gap that is not positive.
    """

    speed: float = 0.05
    backwards: float = 0.05
    turn_rate: float = 0.2
    slip: float = 0.1
    gap: float = 0.5

    def __post_init__(self) -> None:
        if not min(dataclasses.astuple(self)) >= 0 or not self.gap > 0:
            raise ValueError(f"Tolerances must not be negative, and gap positive: got {self}.")


@dataclasses.dataclass(frozen=True)
class TimedPath:
    """A trajectory of ``S`` control steps: ``S + 1`` points, one period apart (float64).

    Args:
        name: of the trajectory.
        time: seconds, ``[S + 1]``, on the recording's clock.
        pose: x, y (m), heading in (-pi, pi] (rad), ``[S + 1, 3]``.
        human: metres, ``[S + 1, 2]``.
        goal: metres, ``[2]``.
        boxes: ``[M, 5]``, see :class:`envs.Scene`.
    """

    name: str
    time: Tensor
    pose: Tensor
    human: Tensor
    goal: Tensor
    boxes: Tensor


def heading_from_motion(position: Tensor) -> Tensor | None:
    """Headings of a robot that drives forwards and does not slip.

    At each point the mean direction of the motion before and after it; exact on lines and arcs. A
    robot that stands keeps its heading, so turning in place cannot be seen.

    Args:
        position: ``[S + 1, 2]``, metres.

    Returns:
        ``[S + 1]``, radians, or ``None`` if the robot does not move.

    Examples:
        >>> import torch
        >>> angle = torch.linspace(0.0, 1.0, 6)
        >>> circle = torch.stack((angle.sin(), 1 - angle.cos()), dim=-1)
        >>> torch.allclose(heading_from_motion(circle), angle, atol=1e-5)
        True
    """
    way = position.diff(dim=0)
    moving = way.norm(dim=-1) >= _STILL
    if not moving.any():
        return None
    # Steps of standing take the direction of the last motion, or of the first one to come.
    latest = torch.where(moving, torch.arange(len(way)), -1).cummax(0).values
    way = way[torch.where(latest < 0, moving.int().argmax(), latest)]
    direction = torch.atan2(way[:, 1], way[:, 0])
    turn = wrap_angle(direction.diff())
    ends = torch.zeros(1).to(turn) if not len(turn) else turn
    before = torch.cat((ends[:1], turn))  # turn between the motions before and after each step
    after = torch.cat((turn, ends[-1:]))
    return torch.cat((direction - before / 2, direction[-1:] + after[-1:] / 2))


def resample(recording: Recording) -> TimedPath | None:
    """The trajectory at the control period, 0.2 s.

    Positions are linear between points, headings take the shortest way. The last point is kept, as
    it may be the one that reaches the goal; less than a period is dropped at the start.

    Args:
        recording: finite, with at least two points and increasing time.

    Returns:
        The path, or ``None`` if it has no heading and the robot does not move. It has one point
        only if the recording is shorter than a period.
    """
    period = NavigationEnv.CONTROL_PERIOD
    # Rounding of the recorded times must not cost the first point.
    steps = int((recording.time[-1] - recording.time[0]) / period + 1e-6)
    time = recording.time[-1] - period * np.arange(steps, -1, -1)

    def at_times(values: np.ndarray) -> Tensor:
        columns = [np.interp(time, recording.time, column) for column in values.T]
        return torch.from_numpy(np.stack(columns, axis=-1))

    position = at_times(recording.position)
    if recording.heading is None:
        heading = heading_from_motion(position) if steps else torch.zeros(1, dtype=torch.float64)
    else:
        heading = at_times(np.unwrap(recording.heading)[:, None])[:, 0]
    if heading is None:
        return None
    return TimedPath(
        recording.name,
        torch.from_numpy(time),
        torch.cat((position, wrap_angle(heading)[:, None]), dim=-1),
        at_times(recording.human),
        torch.from_numpy(recording.goal[-1].copy()),
        torch.from_numpy(recording.boxes),
    )


def velocities(pose: Tensor, next_pose: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Constant velocities that lead from one pose to the next in a control period.

    A differential drive at constant speeds follows an arc whose chord points along the heading in
    the middle of the turn; what the motion has across the chord is slip.

    Args:
        pose: x, y (m), heading (rad), ``[*B, 3]``.
        next_pose: ``[*B, 3]``.

    Returns:
        Forward speed (m/s), turn rate (rad/s) and sideways slip (m/s, positive to the left), each
        ``[*B]``.

    Examples:
        >>> import math, torch
        >>> quarter = torch.tensor([1.0, 1.0, math.pi / 2])  # on a circle of 1 m
        >>> speed, turn, slip = velocities(torch.zeros(3), quarter)
        >>> round((speed / turn).item(), 5), abs(slip.item()) < 1e-6
        (1.0, True)
    """
    period = NavigationEnv.CONTROL_PERIOD
    way = (next_pose - pose)[..., :2]
    turn = wrap_angle(next_pose[..., 2] - pose[..., 2])
    middle = pose[..., 2] + turn / 2
    chord = way[..., 0] * middle.cos() + way[..., 1] * middle.sin()
    across = way[..., 1] * middle.cos() - way[..., 0] * middle.sin()
    # sinc(u) = sin(pi u) / (pi u): the chord is shorter than its arc by sin(turn/2) / (turn/2).
    arc = chord / torch.sinc(turn / (2 * torch.pi))
    return arc / period, turn / period, across / period


def check(
    recording: Recording,
    robot: str | Robot = TURTLEBOT2,
    *,
    goal_radius: float = 0.3,
    max_steps: int = 300,
    tolerances: Tolerances | None = None,
) -> tuple[TimedPath | None, list[str]]:
    """Turn a recording into a path that ends at the goal, or say why the robot cannot drive it.

    Args:
        recording: as read from its file.
        robot: a name from :data:`envs.ROBOTS` or a :class:`envs.Robot`.

    Keyword Args:
        goal_radius: distance from the goal at which it is reached, metres.
        max_steps: longest episode, control steps.
        tolerances: default :class:`Tolerances`.

    Returns:
        The path up to the first point at the goal and an empty list; or ``None`` and the reasons.
    """
    robot, tolerances = get_robot(robot), tolerances or Tolerances()
    reasons = _unusable(recording, tolerances)
    if reasons:
        return None, reasons
    path = resample(recording)
    if path is None:
        return None, ["has no heading and never moves, so that none can be derived"]
    if len(path.time) < 2:
        return None, [f"is shorter than a control step of {NavigationEnv.CONTROL_PERIOD} s"]
    distance = (path.pose[:, :2] - path.goal).norm(dim=-1)
    reached = distance <= goal_radius
    if reached[0]:
        return None, [f"starts within {goal_radius} m of the goal"]
    if reached.any():
        # An episode ends at the goal: what comes after is none of it.
        points = slice(int(reached.int().argmax()) + 1)
        path = dataclasses.replace(
            path, time=path.time[points], pose=path.pose[points], human=path.human[points]
        )
    else:
        reasons.append(
            f"never comes within {goal_radius} m of the goal, {distance.min().item():.2f} m at best"
        )
    steps = len(path.time) - 1
    if steps > max_steps:
        reasons.append(f"takes {steps} control steps, an episode has {max_steps}")
    reasons += _motion_faults(path, robot, tolerances) + _contacts(path, robot)
    return (None, reasons) if reasons else (path, [])


def _unusable(recording: Recording, tolerances: Tolerances) -> list[str]:
    """What rules out resampling."""
    if len(recording.time) < 2:
        return [f"has {len(recording.time)} point(s), fewer than 2"]
    bad = {name: ~np.isfinite(values) for name, values in recording.columns().items()}
    reasons = [
        f"column {name} is not finite at {recording.places[rows.argmax()]}"
        + (f" and {rows.sum() - 1} more" if rows.sum() > 1 else "")
        for name, rows in bad.items()
        if rows.any()
    ]
    if reasons:
        return reasons
    steps = np.diff(recording.time)
    if (steps <= 0).any():
        place = recording.places[(steps <= 0).argmax() + 1]
        reasons.append(f"time does not increase at {place}")
    if steps.max() > tolerances.gap + 1e-9:
        place = recording.places[steps.argmax() + 1]
        reasons.append(f"time jumps by {steps.max():.2f} s at {place}, over {tolerances.gap} s")
    drift = np.linalg.norm(recording.goal - recording.goal[-1], axis=-1).max()
    if drift > _GOAL_DRIFT:
        reasons.append(f"the goal moves by {drift:.2f} m: a trajectory has one goal")
    return reasons


def _motion_faults(path: TimedPath, robot: Robot, tolerances: Tolerances) -> list[str]:
    speed, turn, slip = velocities(path.pose[:-1], path.pose[1:])
    limits = (
        ("drives at", speed, robot.max_speed, tolerances.speed, "m/s"),
        ("drives backwards at", -speed, 0.0, tolerances.backwards, "m/s"),
        ("turns at", turn.abs(), robot.max_turn_rate, tolerances.turn_rate, "rad/s"),
        ("slips sideways at", slip.abs(), 0.0, tolerances.slip, "m/s"),
    )
    reasons = []
    for what, value, limit, tolerance, unit in limits:
        # 1e-6: rounding in a file's decimals is not a fault.
        count = int((value > limit + tolerance + 1e-6).sum())
        if count:
            worst = int(value.argmax())
            reasons.append(
                f"{what} {value[worst].item():.2f} {unit} at {path.time[worst].item():.2f} s, over "
                f"{limit:.2f} + {tolerance:.2f} {unit} in {count} step(s)"
            )
    return reasons


def _contacts(path: TimedPath, robot: Robot) -> list[str]:
    """Contacts by the rule of :class:`NavigationEnv`, at the points of the path."""
    position = path.pose[:, :2]
    gap = (position - path.human).norm(dim=-1) - robot.radius - HUMAN_RADIUS
    gaps = [("the human", gap)]
    if len(path.boxes):
        distance = point_box_distance(position[:, None], path.boxes)
        gaps.append(("a box", distance.amin(-1) - robot.radius))
    return [
        f"touches {what} at {path.time[int((gap <= 0).int().argmax())].item():.2f} s"
        for what, gap in gaps
        if (gap <= 0).any()
    ]
