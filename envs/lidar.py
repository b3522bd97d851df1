"""A planar lidar on every robot of a batch of simulations."""

from __future__ import annotations

import math

import numpy as np
import torch
from mujoco.batch import Batch

from .mjcf import LIDAR_HEIGHT
from .robots import Robot

# Zero would mean "no reading" to many drivers: the nearest range is a millimetre.
MIN_RANGE = 1e-3

# What rays meet: collision geoms, not decoration.
_GROUPS = np.array([1, 0, 0, 0, 0, 0], dtype=np.uint8)
# Of a revolution: fewer cast more rays in vain, more take longer to choose from.
_SECTORS = 72
# Cast in one native call, by all robots together and by each at least: with fewer, calls cost more
# than rays.
_SECTORS_PER_CALL = 300
_LEAST_SECTORS = 8
# Added to the circles, metres: rounding must not take anything from the edge of an obstacle.
_MARGIN = 1e-6


class Lidar:
    """Casts the rays of all environments together, and only where they can meet something.

    Ray 0 points along the heading, the others follow counter-clockwise at equal angles. Few of
    them meet anything: the revolution is cut into sectors, and a sector is cast if a circle around
    some obstacle reaches into it. The ranges are bit-equal to those of casting every ray. Sectors
    outside the robot's field of view are not cast.

    Args:
        batch: the simulations.
        robot: where it carries the lidar, and what the lidar sees.
        body: id of the robot's body, which rays pass through.
        num_rays: per revolution.
        max_range: metres; what no ray meets is that far.
        dtype: of the ranges.
    """

    def __init__(
        self,
        batch: Batch,
        robot: Robot,
        *,
        body: int,
        num_rays: int,
        max_range: float,
        dtype: np.typing.DTypeLike = np.float64,
    ) -> None:
        self.batch = batch
        self.robot = robot
        self.body = body
        self.num_rays = num_rays
        self.max_range = max_range
        self.dtype = dtype
        angles = 2 * math.pi * torch.arange(num_rays, dtype=torch.float64) / num_rays
        rays = torch.stack((angles.cos(), angles.sin()), dim=-1).numpy()
        angles = angles.numpy()
        in_view = np.minimum(angles, 2 * math.pi - angles) <= robot.lidar_fov / 2 + 1e-9
        self._ids = np.flatnonzero(in_view)
        width = math.ceil(num_rays / _SECTORS)
        # The last sector is filled up with the last ray.
        sectors = np.arange(math.ceil(num_rays / width) * width).clip(max=num_rays - 1)
        sectors = sectors.reshape(-1, width)
        self._rays = rays[sectors]
        self._sector_in_view = in_view[sectors].any(-1)
        first, last = angles[sectors[:, 0]], angles[sectors[:, -1]]
        middle, half = (first + last) / 2, (last - first).max() / 2
        self._middle = np.stack((np.cos(middle), np.sin(middle)))
        self._cos_half, self._sin_half = math.cos(half), math.sin(half)

    def cast(
        self,
        position: np.ndarray,
        cos: np.ndarray,
        sin: np.ndarray,
        obstacles: np.ndarray,
        radius: np.ndarray,
        ids: np.ndarray | None = None,
    ) -> np.ndarray:
        """Ranges of the rays in view, metres.

        Args:
            position: of the robots, ``[n, 2]``, metres.
            cos: of their headings, ``[n]``.
            sin: of their headings, ``[n]``.
            obstacles: centres of circles around all that the rays can meet, ``[2, m, n]``: metres
                ahead of the robots, and to their left.
            radius: of these circles, ``[m, n]``, metres.
            ids: their environments, ``[n]``, ascending; ``None`` for all.

        Returns:
            ``[n, rays in view]``, from a millimetre to ``max_range``.
        """
        n, (count, width, _) = len(position), self._rays.shape
        x = position[:, 0] + self.robot.lidar_offset * cos
        y = position[:, 1] + self.robot.lidar_offset * sin
        # Rotated from the robot's frame: cheaper than a sine and a cosine for every ray.
        turn = np.zeros((n, 2, 3))
        turn[:, 0, 0] = turn[:, 1, 1] = cos
        turn[:, 0, 1] = sin
        turn[:, 1, 0] = -sin
        ranges = np.full((n, count, width), self.max_range, self.dtype)
        needed = self._reached(obstacles, radius)
        most = needed.sum(1)
        # Those needed come first. The others fill up the calls.
        order = (~needed).argsort(axis=1, kind="stable")
        done, last = 0, most.max(initial=0)
        while done < last:
            rows = (most > done).nonzero()[0]
            each = max(_LEAST_SECTORS, _SECTORS_PER_CALL // len(rows))
            sectors = order[rows, done : min(done + each, last)]
            done += each
            rays = self._rays[sectors].reshape(len(rows), -1, 2)
            direction = np.matmul(rays, turn[rows])
            # Filled here, entry by entry: Batch.ray would copy the three of every ray by themselves.
            origin = np.empty_like(direction)
            origin[..., 0] = x[rows, None]
            origin[..., 1] = y[rows, None]
            origin[..., 2] = LIDAR_HEIGHT
            distance, _ = self.batch.ray(
                origin,
                direction,
                geomgroup=_GROUPS,
                bodyexclude=self.body,
                ids=rows if ids is None else ids[rows],
            )
            np.copyto(distance, self.max_range, where=distance < 0)
            distance.clip(MIN_RANGE, self.max_range, out=distance)
            ranges[rows[:, None], sectors] = distance.reshape(*sectors.shape, width)
        ranges = ranges.reshape(n, count * width)
        if len(self._ids) < self.num_rays:
            return ranges[:, self._ids]
        return ranges[:, : self.num_rays]

    def _reached(self, centre: np.ndarray, radius: np.ndarray) -> np.ndarray:
        """Which sectors some circle reaches into, ``[n, sectors]``.

        Args:
            centre: of the circles in the robots' frames, ``[2, m, n]``, metres.
            radius: of the circles, ``[m, n]``, metres.
        """
        ahead, left = centre[0] - self.robot.lidar_offset, centre[1]
        square, radius = ahead * ahead + left * left, radius + _MARGIN
        tangent = np.sqrt(np.maximum(square - radius * radius, 0.0))
        # A sector and a circle meet if the angle between their middles is at most the sum of their
        # half angles. With cosines times distances, it takes no trigonometry.
        limit = tangent * self._cos_half - radius * self._sin_half
        limit[tangent == 0.0] = -np.inf
        limit[square > (radius + self.max_range) ** 2] = np.inf
        toward = np.stack((ahead, left), axis=-1) @ self._middle
        return (toward >= limit[..., None]).any(0) & self._sector_in_view

    def scan(self, ranges: np.ndarray) -> np.ndarray:
        """The whole revolution ``[n, num_rays]`` from the ranges of the rays in view."""
        if len(self._ids) == self.num_rays:
            return ranges
        scan = np.full((len(ranges), self.num_rays), self.max_range, ranges.dtype)
        scan[:, self._ids] = ranges
        return scan
