"""What a robot is told of where it is: the scan, the goal and the human, with their faults."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from .faults import Faults
from .geometry import arctan2
from .lidar import MIN_RANGE, Lidar
from .navigation_task import NavigationTask
from .people import FAR
from .robot_ranges import DRIVEN

_FOV, _REACH, _OFFSET = map(DRIVEN.index, ("lidar_fov", "lidar_range", "lidar_offset"))

NOBODY = (4.0, math.pi)
"""Distance (m) and bearing (rad) that are reported of the human where nobody is: what
:attr:`torchrl_morl.deploy.Sensing.nobody` is by default."""


class Perception:
    """Sensors of the robots of a batch.

    Args:
        lidar: on every robot.
        faults: of the sensors.
        generator: from which they are drawn.
        may_be_absent: whether there are scenes without anybody.
        dtype: of what is reported.
    """

    def __init__(
        self,
        lidar: Lidar,
        faults: Faults,
        generator: torch.Generator,
        may_be_absent: bool,
        dtype: torch.dtype,
    ) -> None:
        self.lidar, self.faults, self.dtype = lidar, faults, dtype
        self._generator = generator
        self._may_be_absent = may_be_absent
        self._array_dtype = np.float32 if dtype is torch.float32 else np.float64

    def scan(
        self,
        task: NavigationTask,
        seen: np.ndarray,
        cos: np.ndarray,
        sin: np.ndarray,
        ids: np.ndarray | None,
        amounts: Tensor,
        robots: np.ndarray | None = None,
    ) -> Tensor:
        """Scans ``[n, num_rays]``, metres; arguments as of :meth:`Lidar.cast`.

        Args:
            task: where everything is.
            seen: of it, from the robots.
            cos: of their headings.
            sin: of their headings.
            ids: their environments; ``None`` for all.
            amounts: of the faults there.
            robots: where they differ, ``[n, 8]``: see :data:`envs.robot_ranges.DRIVEN`.
        """
        lidar, faults = self.lidar, self.faults
        offset = None if robots is None else robots[:, _OFFSET]
        ranges = lidar.cast(seen, cos, sin, task.boxes, task.radius, ids, offset)
        if robots is not None:
            ranges = lidar.limit(ranges, robots[:, _FOV], robots[:, _REACH])
        if not faults.disturb_scans:
            return torch.from_numpy(lidar.scan(ranges)).to(self.dtype)
        disturbed = faults.disturb_ranges(
            torch.from_numpy(ranges), amounts, lidar.max_range, self._generator
        )
        scan = torch.from_numpy(lidar.scan(disturbed.clamp(MIN_RANGE, lidar.max_range).numpy()))
        return faults.code_invalid(scan, amounts, lidar.max_range, self._generator).to(self.dtype)

    def polar(
        self,
        task: NavigationTask,
        seen: np.ndarray,
        cos: np.ndarray,
        sin: np.ndarray,
        ids: np.ndarray | None,
        amounts: Tensor,
        time: np.ndarray | None,
    ) -> tuple[Tensor, Tensor]:
        """Distance and bearing of goal and human, ``[n, 2]`` each; arguments as of :meth:`scan`.

        Args:
            task: where everything is.
            seen: of it, from the robots.
            cos: of their headings.
            sin: of their headings.
            ids: their environments; ``None`` for all.
            amounts: of the faults there.
            time: since the start, ``[n]``, seconds; ``None`` where no fault depends on it.
        """
        rows = slice(None) if ids is None else ids
        ahead, left = seen[:, :2]
        if task.people.shape[1] > 1:
            human = seen[:, 1 + task.nearest[rows], np.arange(seen.shape[-1])]
            ahead, left = np.stack((seen[:, 0], human), axis=1)
        distance = task.distance[:, rows]
        faults = self.faults
        if faults.misreport:
            at = torch.from_numpy(time)
            offset = np.zeros((2, 2, len(time)))  # of goal and human, x and y
            if faults.most["goal_drift"]:
                offset[0] = faults.goal_offset(amounts, at).T.numpy()
            if faults.misreport_human:
                offset[1] = faults.human_offset(amounts, self._generator).T.numpy()
            ahead = ahead + cos * offset[:, 0] + sin * offset[:, 1]
            left = left + cos * offset[:, 1] - sin * offset[:, 0]
            distance = np.maximum(np.hypot(ahead, left), MIN_RANGE)
        polar = np.empty((2, *distance.shape[1:], 2), self._array_dtype)
        polar[..., 0] = distance
        polar[..., 1] = arctan2(left, ahead)
        if self._may_be_absent:
            polar[1, task.distance[1, rows] > FAR / 2] = NOBODY
        if faults.most["human_lost"]:
            polar[1, faults.loses_human(amounts, torch.from_numpy(time)).numpy()] = NOBODY
        goal, human = (torch.from_numpy(values).to(self.dtype) for values in polar)
        return goal, human
