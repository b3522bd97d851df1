"""A recorded trajectory at the control period: resampling, headings and velocities."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from torch import Tensor

from torchrl_morl.geometry import wrap_angle

from ..navigation import NavigationEnv
from .recordings import Recording

# A motion shorter than this within a step has no reliable direction, metres.
_STILL = 0.01


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

    def first(self, points: int) -> TimedPath:
        """The path up to and with this many points."""
        return dataclasses.replace(
            self,
            time=self.time[:points],
            pose=self.pose[:points],
            human=self.human[:points],
        )


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
