"""Sectors from the scan of any planar lidar."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Sequence, Sized

import numpy as np
from numpy.typing import ArrayLike

from torchrl_morl.arguments import check_count, check_positive, is_number

from .onnx_runner import as_reported, numbers_of, numeric_ranges
from .sensing import LARGEST, NUM_BASE, NUM_ROBOT, Sensing

__all__ = ["LidarGeometry", "sector_of"]

SECTOR_EDGE = 1e-4
"""Share of a sector within which a beam before its start belongs to it: angles are rounded."""

_FURTHEST_MOUNT = 10.0
_REVOLUTION = 2 * math.pi + 1e-3
_MOST_BEAMS = 1_000_000


def sector_of(angle: np.ndarray, num_sectors: int) -> np.ndarray:
    """Sectors in which angles (rad, from straight ahead) lie, before they are taken modulo their number.

    Example:
        >>> sector_of(np.array([0.0, 3.2, -0.1]), 4)
        array([ 0.,  2., -1.])
    """
    return np.floor(angle * (num_sectors / (2 * math.pi)) + SECTOR_EDGE)


@dataclasses.dataclass(frozen=True)
class LidarGeometry:
    """Where the beams of a planar lidar point, and which of its readings mean something.

    The fields are those of ROS's ``sensor_msgs/LaserScan``. A reading is

    ==================================  ============================================================
    reading                             meaning
    ==================================  ============================================================
    ``range_min`` to ``range_max``      an obstacle at that distance
    inf, ``range_max`` and above        free (`REP 117 <https://www.ros.org/reps/rep-0117.html>`_)
    -inf                                an obstacle too close to be measured: at ``range_min``
    NaN, 0, negative, below             invalid: as if the beam did not exist
    ==================================  ============================================================

    Args:
        first_angle: of beam 0, radians, counter-clockwise from the lidar's own x axis.
        increment: from beam to beam, radians; negative for a clockwise scan, or for a lidar that is
            mounted upside down.
        num_beams: of a scan.
        range_min: nearest valid range, metres.
        range_max: furthest one, metres.
        mount: of the lidar in the frame of the robot, whose origin is the rotation centre: x ahead
            and y to the left (m), yaw (rad).

    Raises:
        ValueError: for values that are not finite, no beams, more than a revolution of them, or angles
            in degrees.

    Example:
        >>> import numpy as np
        >>> lidar = LidarGeometry(-np.pi / 2, np.pi / 4, 5, range_min=0.1, range_max=8.0)
        >>> lidar.sectors([3.0, 0.0, 2.0, np.inf, 1.0], num_sectors=4, max_range=4.0)
        array([ 2.,  1., nan,  3.])
    """

    first_angle: float
    increment: float
    num_beams: int
    range_min: float
    range_max: float
    mount: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        for name in ("first_angle", "increment", "range_min", "range_max"):
            if not is_number(getattr(self, name)):
                raise self._refused(name, "finite")
        if not isinstance(self.mount, Sequence | np.ndarray) or len(self.mount) != 3:
            raise self._refused("mount", "x, y and yaw")
        if not all(map(is_number, self.mount)):
            raise self._refused("mount", "x, y and yaw, all finite")
        object.__setattr__(self, "mount", tuple(map(float, self.mount)))
        if not isinstance(self.num_beams, int | np.integer) or isinstance(self.num_beams, bool):
            raise self._refused("num_beams", "an integer")
        object.__setattr__(self, "num_beams", int(self.num_beams))
        if self.num_beams < 1:
            raise self._refused("num_beams", "at least 1")
        if self.num_beams > _MOST_BEAMS:
            raise self._refused("num_beams", f"at most {_MOST_BEAMS}")
        # Degrees are larger; what drivers round may pass a revolution by a little.
        if abs(self.first_angle) > _REVOLUTION:
            raise self._refused("first_angle", "within a revolution, in radians")
        if abs(self.mount[2]) > _REVOLUTION:
            raise self._refused("mount", "x, y and yaw, which is within a revolution, in radians")
        # Millimetres are larger: from there every obstacle would read as far away.
        if math.hypot(*self.mount[:2]) > _FURTHEST_MOUNT:
            raise self._refused(
                "mount", f"within {_FURTHEST_MOUNT:g} m of the rotation centre, in metres"
            )
        if self.increment == 0:
            raise self._refused("increment", "different from 0")
        # Drivers may report the first beam again as the last one.
        if abs(self.increment) * (self.num_beams - 1) > _REVOLUTION:
            raise ValueError(
                f"lidar: {self.num_beams} beams every {self.increment:g} rad are more than a "
                "revolution: is the increment in radians?"
            )
        if not 0 <= self.range_min < self.range_max:
            raise self._refused("range_min", f"between 0 and range_max, {self.range_max:g}")

    def sectors(
        self,
        ranges: ArrayLike,
        num_sectors: int,
        max_range: float,
        origin: tuple[float, float] = (0.0, 0.0),
    ) -> np.ndarray:
        """Shortest range in each sector around a point of the robot.

        Beams are sorted by angle, not resampled: an edge that one beam grazes is kept. If the lidar
        is not mounted at ``origin``, the end points of its beams are seen from there.

        Args:
            ranges: ``[*B, num_beams]``, metres.
            num_sectors: around the robot; the first starts straight ahead, the others follow
                counter-clockwise.
            max_range: what is free, or further, reads so, metres.
            origin: x and y of that point in the frame of the robot, metres.

        Returns:
            ``[*B, num_sectors]``, float64, metres; NaN for a sector without a valid beam, of which
            nothing is known.

        Raises:
            ValueError: for a scan with another number of beams, or one that is not numbers, and for
                other arguments that make no sense.
        """
        check_count("num_sectors", num_sectors)
        check_positive("max_range", max_range)
        if (
            not isinstance(origin, Sequence | np.ndarray)
            or len(origin) != 2
            or not all(map(is_number, origin))
        ):
            raise ValueError(f"origin must be x and y, both finite, got {origin!r}.")
        ranges = numeric_ranges(ranges, self.num_beams)
        batch = ranges.shape[:-1]
        ranges = ranges.reshape(-1, self.num_beams)
        near, far = self.thresholds
        valid = (ranges >= near) & (ranges > 0)  # not NaN
        too_close = ranges == -math.inf
        free = ranges >= far
        length = np.where(too_close, self.range_min, np.where(free, max_range, ranges))
        valid |= too_close
        x, y, _ = self.mount
        ahead, left = x - origin[0], y - origin[1]
        if math.hypot(ahead, left) < 1e-9:
            angle = np.broadcast_to(self.angles, ranges.shape)
            length = np.minimum(length, max_range)
        else:
            with np.errstate(invalid="ignore"):
                point_x = ahead + length * self._directions[0]
                point_y = left + length * self._directions[1]
            angle = np.arctan2(point_y, point_x)
            length = np.where(free, max_range, np.minimum(np.hypot(point_x, point_y), max_range))
        with np.errstate(invalid="ignore"):
            sector = sector_of(angle, num_sectors)
        out = np.full(len(ranges) * num_sectors, np.inf)
        row, beam = valid.nonzero()
        at = row * num_sectors + sector[row, beam].astype(np.int64) % num_sectors
        np.minimum.at(out, at, length[row, beam])
        out[np.isinf(out)] = np.nan
        return out.reshape(*batch, num_sectors)

    def check(self, sensing: Sensing) -> None:
        """Refuse a lidar that leaves gaps between its beams as wide as a sector.

        Raises:
            ValueError: if sectors within the field of view stay without a beam.
        """
        width = 2 * math.pi / sensing.num_sectors
        if abs(self.increment) > width * (1 + SECTOR_EDGE):
            raise ValueError(
                f"lidar: beams every {math.degrees(abs(self.increment)):.1f} degrees leave sectors of "
                f"{math.degrees(width):.1f} degrees without one: the policy needs at least "
                f"{sensing.num_sectors} beams a revolution."
            )

    def robot(self, sensing: Sensing, numbers: Sequence[float] | None) -> tuple[float, ...] | None:
        """The robot that carries this lidar, for policies that read it.

        Args:
            sensing: of the policy.
            numbers: radius (m), top speed (m/s) and top turn rate (rad/s) of the base. Behind them may
                stand the lidar's view (rad), range (m) and distance ahead of the rotation centre (m),
                where less of it is to count than it has.

        Returns:
            All six, as :meth:`Sensing.robot` does; ``None`` where the policy reads none.

        Raises:
            ValueError: for what :meth:`Sensing.robot` refuses, and for a view, a range or a place that
                this lidar does not have.

        Example:
            >>> lidar = LidarGeometry(-2.0, 0.01, 401, 0.1, 8.0, mount=(0.1, 0.0, 0.0))
            >>> lidar.robot(Sensing(observe_robot=True), (0.25, 0.8, 3.0))
            (0.25, 0.8, 3.0, 4.01, 8.0, 0.1)
            >>> lidar.robot(Sensing(observe_robot=True), (0.25, 0.8, 3.0, 4.0, 12.0, 0.1))
            Traceback (most recent call last):
            ...
            ValueError: robot: the range of the lidar is 12 m, but range_max=8 of lidar=: leave the \
lidar's three numbers out.
        """
        view = min(abs(self.increment) * self.num_beams, 2 * math.pi)
        furthest, _ = LARGEST["range of the lidar"]
        own = view, min(self.range_max, furthest), self.mount[0]
        if sensing.observe_robot and _size(numbers) not in (None, NUM_ROBOT):
            base = numbers_of(
                "robot",
                numbers,
                "three numbers, radius, top speed and top turn rate, or six",
                NUM_BASE,
            )
            return sensing.robot((*base, *own))
        found = sensing.robot(numbers)
        if found is not None:
            self._check_robot(found, own)
        return found

    def _check_robot(self, robot: Sequence[float], own: Sequence[float]) -> None:
        # Numbers are rounded, a range is reported in float32.
        view, reach, ahead = robot[NUM_BASE:]
        wrong = (
            (view > own[0] * 1.01 + 0.01, "view", view, "rad", f"{own[0]:.4g} rad of"),
            (reach > own[1] * 1.001, "range", reach, "m", f"range_max={own[1]:g} of"),
            (abs(ahead - own[2]) > 0.01, "place ahead", ahead, "m", f"mount x={own[2]:g} of"),
        )
        for is_wrong, name, value, unit, theirs in wrong:
            if is_wrong:
                raise ValueError(
                    f"robot: the {name} of the lidar is {value:g} {unit}, but {theirs} lidar=: leave the "
                    "lidar's three numbers out."
                )

    @functools.cached_property
    def thresholds(self) -> tuple[float, float]:
        """From where on a reading is valid, and from where on free, metres, as drivers report them."""
        return as_reported(self.range_min), as_reported(self.range_max)

    @functools.cached_property
    def angles(self) -> np.ndarray:
        """Of the beams in the frame of the robot, radians."""
        return self.mount[2] + self.first_angle + self.increment * np.arange(self.num_beams)

    @functools.cached_property
    def _directions(self) -> tuple[np.ndarray, np.ndarray]:
        return np.cos(self.angles), np.sin(self.angles)

    def _refused(self, name: str, allowed: str) -> ValueError:
        return ValueError(f"lidar: {name} must be {allowed}, got {getattr(self, name)!r}.")


def _size(numbers: object) -> int | None:
    return None if numbers is None else len(numbers) if isinstance(numbers, Sized) else 1
