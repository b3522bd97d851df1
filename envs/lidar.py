"""A planar lidar on every robot of a batch of simulations."""

from __future__ import annotations

import math
from collections.abc import Callable

import numba
import numpy as np

from .robots import Robot

# Zero would mean "no reading" to many drivers: the nearest range is a millimetre.
MIN_RANGE = 1e-3

# Added to the circles around obstacles, metres: rounding must not take anything from their edges.
_MARGIN = 1e-6


class Lidar:
    """Casts the rays of all environments in one compiled call, and only where they can meet something.

    A planar lidar sees a circle, the human, and boxes, which stand upright: their intersections with
    rays are closed forms, and only the rays between the tangents of a circle around an obstacle, a few
    dozen of a revolution, can meet it. Ranges are those of :meth:`mujoco.batch.Batch.ray` but for
    rounding. Other geoms of the model are invisible to it.

    Ray 0 points along the heading, the others follow counter-clockwise at equal angles.

    Args:
        robot: where it carries the lidar, and what the lidar sees.
        num_rays: per revolution.
        max_range: metres; what no ray meets is that far.
        dtype: of the ranges.
    """

    def __init__(
        self,
        robot: Robot,
        *,
        num_rays: int,
        max_range: float,
        dtype: np.typing.DTypeLike = np.float64,
    ) -> None:
        self.robot, self._offset = robot, np.empty(0)
        self.num_rays = num_rays
        self.max_range = max_range
        self.dtype = dtype
        angles = 2 * math.pi * np.arange(num_rays) / num_rays
        self._rays = np.stack((np.cos(angles), np.sin(angles)), axis=-1)
        in_view = np.minimum(angles, 2 * math.pi - angles) <= robot.lidar_fov / 2 + 1e-9
        self._ids = np.flatnonzero(in_view)

    def cast(
        self,
        seen: np.ndarray,
        cos: np.ndarray,
        sin: np.ndarray,
        boxes: np.ndarray,
        radius: np.ndarray,
        ids: np.ndarray | None = None,
        offset: np.ndarray | None = None,
    ) -> np.ndarray:
        """Ranges of the rays in view, metres.

        Args:
            seen: goal, people and boxes from the robots, ``[2, 1 + P + B, n]``: metres ahead of
                their centres, and to their left. Rays pass through the goal.
            cos: of the robots' headings, ``[n]``.
            sin: of the robots' headings, ``[n]``.
            boxes: of all ``N`` environments, ``[N, B, 5]``: x, y, heading, half length, half width.
            radius: of circles around people and boxes, ``[P + B, N]``, metres.
            ids: which environments the ``n`` robots are in; ``None`` for all.
            offset: of the lidars, where they differ, ``[n]``, metres ahead of the centres.

        Returns:
            ``[n, rays in view]``, from a millimetre to ``max_range``.
        """
        rows = np.arange(len(cos)) if ids is None else ids
        ranges = np.full((len(rows), self.num_rays), self.max_range, self.dtype)
        if offset is None:
            if len(self._offset) < len(rows):
                self._offset = np.full(len(rows), self.robot.lidar_offset)
            offset = self._offset[: len(rows)]
        _cast(ranges, seen, cos, sin, rows, boxes, radius, self._rays, offset)
        return ranges if len(self._ids) == self.num_rays else ranges[:, self._ids]

    def limit(self, scan: np.ndarray, fov: np.ndarray, reach: np.ndarray) -> np.ndarray:
        """Whole scans ``[n, num_rays]`` of lidars that see less: what they miss is no return.

        Args:
            scan: it is changed in place.
            fov: of each, ``[n]``, radians.
            reach: of each, ``[n]``, metres.
        """
        angle = 2 * math.pi * np.arange(self.num_rays) / self.num_rays
        away = np.minimum(angle, 2 * math.pi - angle)
        missed = (away > fov[:, None] / 2 + 1e-9) | (scan > reach[:, None])
        scan[missed] = self.max_range
        return scan

    def scan(self, ranges: np.ndarray) -> np.ndarray:
        """The whole revolution ``[n, num_rays]`` from the ranges of the rays in view."""
        if self.robot.lidar_range < self.max_range:
            ranges = np.where(ranges > self.robot.lidar_range, self.max_range, ranges)
        if len(self._ids) == self.num_rays:
            return ranges
        scan = np.full((len(ranges), self.num_rays), self.max_range, ranges.dtype)
        scan[:, self._ids] = ranges
        return scan


def compiled(function: Callable) -> Callable:
    """Compiled on first use, a second, and kept on disk for the next process where that is possible."""
    try:
        return numba.njit(function, cache=True, nogil=True)
    except RuntimeError:  # neither this folder nor the user's cache can be written
        return numba.njit(function, nogil=True)


@compiled
def _circle_range(x, y, u, v, radius):
    """Range from the origin along the unit vector (u, v) to a circle around (x, y)."""
    middle = x * u + y * v
    square = middle * middle - (x * x + y * y - radius * radius)
    if square < 0.0:
        return math.inf
    half = math.sqrt(square)
    near = middle - half if middle >= half else middle + half
    return near if near >= 0.0 else math.inf


@compiled
def _box_range(x, y, u, v, half_length, half_width):
    """Range from (x, y) along the unit vector (u, v), in the frame of the box."""
    near, far = -math.inf, math.inf
    for start, way, half in ((x, u, half_length), (y, v, half_width)):
        if way == 0.0:
            if abs(start) > half:
                return math.inf
        else:
            first, second = (-half - start) / way, (half - start) / way
            near, far = max(near, min(first, second)), min(far, max(first, second))
    if near > far or far < 0.0:
        return math.inf
    return near if near >= 0.0 else far  # from inside, where the ray leaves


@compiled
def _rays_between_tangents(x, y, radius, max_range, num_rays):
    """First and last ray, which may count on beyond a revolution, that a circle around (x, y) can meet."""
    distance = math.hypot(x, y)
    if distance > radius + max_range:
        return 0, -1
    if distance <= radius:
        return 0, num_rays - 1
    middle, half = math.atan2(y, x), math.asin(radius / distance)
    step = 2 * math.pi / num_rays
    return math.ceil((middle - half) / step), math.floor((middle + half) / step)


@compiled
def _cast(ranges, seen, cos, sin, rows, boxes, radius, rays, offsets):
    """Lower ``ranges`` [n, rays], full of the largest one, to what the rays meet."""
    num_rays = len(rays)
    people = seen.shape[1] - 1 - boxes.shape[1]
    for robot in range(len(rows)):
        row, scan, max_range = rows[robot], ranges[robot], ranges[robot, 0]
        offset = offsets[robot]
        for item in range(people):
            x, y, circle = (
                seen[0, 1 + item, robot] - offset,
                seen[1, 1 + item, robot],
                radius[item, row],
            )
            first, last = _rays_between_tangents(x, y, circle + _MARGIN, max_range, num_rays)
            for index in range(first, last + 1):
                ray = index % num_rays
                near = _circle_range(x, y, rays[ray, 0], rays[ray, 1], circle)
                scan[ray] = max(min(near, scan[ray]), MIN_RANGE)
        for item in range(boxes.shape[1]):
            x, y, box = (
                seen[0, 1 + people + item, robot] - offset,
                seen[1, 1 + people + item, robot],
                boxes[row, item],
            )
            around = radius[people + item, row] + _MARGIN
            first, last = _rays_between_tangents(x, y, around, max_range, num_rays)
            # The turn from the robot's frame into that of the box.
            c, s = math.cos(box[2]), math.sin(box[2])
            c, s = c * cos[robot] + s * sin[robot], s * cos[robot] - c * sin[robot]
            along, across = -(c * x + s * y), s * x - c * y
            for index in range(first, last + 1):
                ray = index % num_rays
                u, v = rays[ray]
                near = _box_range(along, across, c * u + s * v, c * v - s * u, box[3], box[4])
                scan[ray] = max(min(near, scan[ray]), MIN_RANGE)
