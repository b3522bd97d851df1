"""A planar lidar on every robot of a batch of simulations."""

from __future__ import annotations

import math

import numpy as np
import torch
from mujoco.batch import Batch
from torch import Tensor

from .geometry import wrap_angle
from .mjcf import LIDAR_HEIGHT
from .robots import Robot

# What rays meet: collision geoms, not decoration.
_GROUPS = np.array([1, 0, 0, 0, 0, 0], dtype=np.uint8)


class Lidar:
    """One native call casts the rays of all environments.

    Ray 0 points along the heading, the others follow counter-clockwise at equal angles. Rays
    outside the robot's field of view are not cast.

    Args:
        batch: the simulations.
        robot: where it carries the lidar, and what the lidar sees.
        body: id of the robot's body, which rays pass through.
        num_rays: per revolution.
        max_range: metres; what no ray meets is that far.
    """

    def __init__(
        self, batch: Batch, robot: Robot, *, body: int, num_rays: int, max_range: float
    ) -> None:
        self.batch = batch
        self.robot = robot
        self.body = body
        self.num_rays = num_rays
        self.max_range = max_range
        angles = 2 * math.pi * torch.arange(num_rays, dtype=torch.float64) / num_rays
        in_view = wrap_angle(angles).abs() <= robot.lidar_fov / 2 + 1e-9
        self._ids = in_view.nonzero().squeeze(-1)
        angles = angles[self._ids]
        self._rays = torch.stack((angles.cos(), angles.sin()), dim=-1).numpy()
        # As large as the native call wants them, which copies anything smaller.
        self._origin = np.full((batch.nsim, len(self._rays), 3), LIDAR_HEIGHT)
        self._direction = np.zeros_like(self._origin)

    def cast(self, position: Tensor, cos: Tensor, sin: Tensor, ids: Tensor | None) -> Tensor:
        """Ranges of the rays in view, metres.

        Args:
            position: of the robots, ``[n, 2]``, metres, float64.
            cos: of their headings, ``[n]``.
            sin: of their headings, ``[n]``.
            ids: their environments, ``[n]``; ``None`` for all.

        Returns:
            ``[n, rays in view]``, from 0 to ``max_range``.
        """
        n = len(position)
        x, y = position[:, 0:1].numpy(), position[:, 1:2].numpy()
        cos, sin = cos.numpy(), sin.numpy()
        # Rotated from the robot's frame: cheaper than a sine and a cosine for every ray.
        turn = np.zeros((n, 2, 3))
        turn[:, 0, 0] = turn[:, 1, 1] = cos
        turn[:, 0, 1] = sin
        turn[:, 1, 0] = -sin
        direction = np.matmul(self._rays, turn, out=self._direction[:n])
        origin = self._origin[:n]
        origin[..., 0] = x + self.robot.lidar_offset * cos[:, None]
        origin[..., 1] = y + self.robot.lidar_offset * sin[:, None]
        distance, _ = self.batch.ray(
            origin,
            direction,
            geomgroup=_GROUPS,
            bodyexclude=self.body,
            ids=None if ids is None else ids.numpy(),
        )
        np.copyto(distance, self.max_range, where=distance < 0)
        return torch.from_numpy(distance)

    def scan(self, ranges: Tensor) -> Tensor:
        """The whole revolution ``[n, num_rays]`` from the ranges of the rays in view, in place."""
        # Zero would mean "no reading" to many drivers: the nearest range is a millimetre.
        ranges = ranges.clamp_(1e-3, self.max_range)
        if len(self._ids) == self.num_rays:
            return ranges
        scan = ranges.new_full((len(ranges), self.num_rays), self.max_range)
        scan[:, self._ids] = ranges
        return scan
