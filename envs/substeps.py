"""A control step of the physics: people walk in it, and contacts are looked for at every substep."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from mujoco.batch import Batch
from torch import Tensor

from .navigation_task import NavigationTask

_SUBSTEPS = 4
"""In which contacts are looked for, of 0.05 s each."""

# What comes nearer in a step, over its speed: servos and contacts overshoot a little.
_REACH = 1.2


class Substeps:
    """Advances all simulations by a control step.

    Only robots that can touch something within it are looked at in between: the others take the step
    at once, with the same result.

    Args:
        frame_skip: steps of the physics.
        period: of a control step, seconds.
        human_speed: of the fastest person, m/s; 0 where nobody walks.
        robot_speed: of the fastest robot, m/s.
        mocap_people: where people are in ``mocap_pos``.
    """

    def __init__(
        self,
        *,
        frame_skip: int,
        period: float,
        human_speed: float,
        robot_speed: float,
        mocap_people: list[int],
    ) -> None:
        self.frame_skip, self.period, self.mocap_people = frame_skip, period, mocap_people
        self.human_speed = human_speed
        self.reach = _REACH * (robot_speed + human_speed) * period

    def advance(
        self,
        batch: Batch,
        view: Mapping[str, Tensor],
        task: NavigationTask,
        time: np.ndarray | None,
    ) -> None:
        """Step the physics and move the people.

        Args:
            batch: the simulations.
            view: of their state.
            task: whose robots are located where they are; it is told what they touch.
            time: since the start of each episode, ``[N]``, seconds; ``None`` where nobody walks.
        """
        position = view["qpos"].numpy()[:, :2]
        rows = task.may_touch(position, self.reach)
        if not len(rows):
            self._walk(view, task, self.period, time, None)
            batch.step(nstep=self.frame_skip)
            return
        far = np.delete(np.arange(len(position)), rows)
        if len(far):
            self._walk(view, task, self.period, time, far)
            batch.step(far, nstep=self.frame_skip)
        length = self.period / _SUBSTEPS
        for step in range(_SUBSTEPS):
            self._walk(view, task, length, time, rows, step * length)
            batch.step(rows, nstep=self.frame_skip // _SUBSTEPS)
            if step < _SUBSTEPS - 1:
                task.touch(rows, position[rows])

    def _walk(
        self,
        view: Mapping[str, Tensor],
        task: NavigationTask,
        seconds: float,
        time: np.ndarray | None,
        rows: np.ndarray | None,
        later: float = 0.0,
    ) -> None:
        if self.human_speed:
            if rows is None:
                rows = np.arange(len(time))
            task.walk(seconds, time[rows] + later, rows)
            position = view["mocap_pos"].numpy()
            position[rows[:, None], self.mocap_people, :2] = task.people[rows, :, :2]
