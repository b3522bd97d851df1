"""Recordings in another unit or frame than the format's: which one would make sense of them."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from .recordings import Recording
from .report import Reason

_UNITS = {"milliseconds": 1e3, "microseconds": 1e6, "nanoseconds": 1e9}
# Mean speeds of robots on wheels, m/s.
_SPEEDS = (0.02, 2.0)

_FRAMES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "": lambda heading: heading,
    "clockwise": lambda heading: -heading,
    "clockwise from the y axis, or with x and y swapped": lambda heading: math.pi / 2 - heading,
    "counter-clockwise from the y axis": lambda heading: heading + math.pi / 2,
}


def unit_of_time(recording: Recording) -> str | None:
    """The unit, other than seconds, in which the robot's mean speed is that of a robot.

    Examples:
        >>> import numpy as np
        >>> from envs.demonstrations.recordings import Recording
        >>> x = np.linspace(0.0, 4.0, 101)
        >>> way, still = np.stack((x, 0 * x), axis=-1), np.zeros((101, 2))
        >>> rows = np.arange(101)
        >>> unit_of_time(Recording("a", 1000 * x / 0.4, way, None, still, still, still, rows))
        'milliseconds'
    """
    way = np.linalg.norm(np.diff(recording.position, axis=0), axis=-1).sum()
    speed = way / (recording.time[-1] - recording.time[0])
    for unit, factor in _UNITS.items():
        if _SPEEDS[0] <= speed * factor <= _SPEEDS[1]:
            return unit
    return None


def heading_convention(recording: Recording, fits: Callable[[np.ndarray], bool]) -> Reason | None:
    """The convention in which the heading agrees with the motion, as a reason to reject it.

    Args:
        recording: whose heading does not agree with its motion in radians, counter-clockwise from
            the x axis.
        fits: whether a heading ``[T]`` does.
    """
    assert recording.heading is not None
    most = int(np.abs(recording.heading).argmax())
    value, place = recording.heading[most], recording.place(most)
    # Within a turn degrees cannot be told from radians.
    degrees = abs(value) > 2 * math.pi
    for scale, unit in ((1.0, ""), (math.pi / 180, "degrees")):
        if unit and not degrees:
            continue
        for label, frame in _FRAMES.items():
            if (unit or label) and fits(frame(scale * recording.heading)):
                what = " ".join(filter(None, (unit, label)))
                expected = "radians, counter-clockwise from the x axis, are expected"
                return Reason(
                    f"{value:g} in heading at {place}: {what}? {expected}",
                    f"whose heading fits in {what}" if unit else f"whose heading fits {what}",
                    expected,
                )
    return None
