"""Messages of ROS 2 as they look to whoever reads their fields, without ROS."""

from __future__ import annotations

import math
from types import SimpleNamespace as Fields

import numpy as np


def header(stamp: float, frame: str) -> Fields:
    return Fields(stamp=Fields(sec=int(stamp), nanosec=round(stamp % 1 * 1e9)), frame_id=frame)


def point(x: float, y: float, z: float = 0.0) -> Fields:
    return Fields(x=x, y=y, z=z)


def turn(yaw: float = 0.0, roll: float = 0.0) -> Fields:
    """A roll about x, then a yaw about the fixed z."""
    cy, sy, cr, sr = math.cos(yaw / 2), math.sin(yaw / 2), math.cos(roll / 2), math.sin(roll / 2)
    return Fields(x=cy * sr, y=sy * sr, z=sy * cr, w=cy * cr)


def pose(x: float, y: float, yaw: float = 0.0) -> Fields:
    return Fields(position=point(x, y), orientation=turn(yaw))


def transform(x: float, y: float, yaw: float = 0.0, roll: float = 0.0) -> Fields:
    return Fields(translation=point(x, y), rotation=turn(yaw, roll))


def scan(stamp: float, ranges=None, frame: str = "base_link", **changes) -> Fields:
    ranges = np.full(360, math.inf) if ranges is None else ranges
    given = {
        "angle_min": -math.pi,
        "angle_increment": 2 * math.pi / max(len(ranges), 1),
        "range_min": 0.1,
        "range_max": 8.0,
        "ranges": ranges,
    }
    return Fields(header=header(stamp, frame), **(given | changes))


def odometry(
    stamp: float, x: float = 0.0, y: float = 0.0, yaw: float = 0.0, frame="odom"
) -> Fields:
    return Fields(header=header(stamp, frame), pose=Fields(pose=pose(x, y, yaw)))


def stamped(stamp: float, x: float, y: float, frame: str = "odom") -> Fields:
    return Fields(header=header(stamp, frame), pose=pose(x, y))


def array(stamp: float, *places: tuple[float, float], frame: str = "odom") -> Fields:
    return Fields(header=header(stamp, frame), poses=[pose(*place) for place in places])


def people(stamp: float, *each: tuple[float, float, float, float], frame: str = "odom") -> Fields:
    """x, y and velocity of each."""
    found = [Fields(position=point(x, y), velocity=point(vx, vy)) for x, y, vx, vy in each]
    return Fields(header=header(stamp, frame), people=found)
