"""What runners are given, and why they stop: the same for the one of the library, of ONNX and of C++."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

from torchrl_morl.deploy import LidarGeometry

LIDAR = LidarGeometry(-math.pi, 2 * math.pi / 360, 360, range_min=0.12, range_max=3.5)
PREFERENCE = (0.2, 0.3, 0.5)
NAN, INF = math.nan, math.inf


def step(runner: Any, time: float = 10.0, **changes: Any) -> Any:
    """A step with inputs of which all is well, apart from the changes."""
    arguments = {
        "ranges": np.full(360, INF),
        "goal": (3.0, 0.1),
        "preference": PREFERENCE,
        "stamp": time - 0.05,
        "time": time,
        "human": (2.0, 0.5),
    } | changes
    return runner.step(arguments.pop("ranges"), **arguments)


STOPS = [
    ({"goal": (0.3, 1.0)}, "goal reached", "0.30 m away"),
    ({"goal": (0.0, 0.0)}, "goal reached", "0.00 m away"),
    ({"goal": None}, "no goal", "None"),
    ({"ranges": None}, "no scan", "None"),
    ({"ranges": np.full(360, NAN)}, "no scan", "no valid beam"),
    ({"ranges": np.zeros(360)}, "no scan", "no valid beam"),
    ({"stamp": 9.7}, "stale", "0.30 s old, at most 0.2 s"),
    ({"stamp": 10.5}, "clock", "0.50 s later than time: two clocks"),
    ({"stamp": NAN}, "clock", "must be finite"),
    ({"time": INF}, "clock", "must be finite"),
    ({"stamp": None}, "clock", "must be finite"),
    ({"goal": (NAN, 0.0)}, "refused", "goal must be finite"),
    ({"goal": (3.0, INF)}, "refused", "goal must be finite"),
    ({"goal": (-3.0, 0.0)}, "refused", "goal must be finite, with a distance of at least 0"),
    ({"goal": 3.0}, "refused", "goal must be a distance and a bearing"),
    ({"goal": "here"}, "refused", "goal must be a distance and a bearing"),
    ({"human": (NAN, 0.0)}, "refused", "human must be finite"),
    ({"human": (0.0, 0.0)}, "refused", "at 0 m: for nobody pass human=None"),
    ({"preference": (1e6, 0, 0)}, "refused", "sums to 1e+06"),
    ({"preference": (-1, 1, 1)}, "refused", "preference[0] = -1 for objective 'demo'"),
    ({"preference": (1, 1, 0)}, "refused", "sums to 2; it must sum to 1"),
    ({"preference": (0.5, 0.5)}, "refused", "preference must have shape [..., 3], got [2]"),
    ({"preference": (NAN, 0.5, 0.5)}, "refused", "'preference'[0] = nan"),
    ({"preference": None}, "refused", "preference"),
    ({"preference": [PREFERENCE] * 2}, "refused", "one preference at a time, got 2"),
    ({"ranges": np.ones(361)}, "refused", "ranges must have shape [..., 360]"),
    ({"ranges": np.ones((2, 360))}, "refused", "one scan at a time, got 2"),
    ({"ranges": ["a"] * 360}, "refused", "ranges must be numbers"),
]
"""Inputs, the reason why they stop the robot, and what the detail says of it."""


class Hostile:
    """An object that raises whatever it likes."""

    def __init__(self, error: Exception) -> None:
        self.error = error

    def __iter__(self):
        raise self.error

    def __array__(self, *args, **kwargs):
        raise self.error

    def __repr__(self) -> str:
        raise self.error


NO_INPUTS = [
    ({"goal": (10**400, 0.0)}, "refused", "goal must be a distance and a bearing"),
    ({"goal": {3.0, 0.1}}, "refused", "goal must be a distance and a bearing, got {"),
    ({"goal": {3.0: 1, 0.1: 2}}, "refused", "goal must be a distance and a bearing, got {3.0: 1"),
    ({"human": (2.0,)}, "refused", "human must be a distance and a bearing, got (2.0,)"),
    ({"odometry": (1.0, 2.0)}, "refused", "odometry must be x, y and heading, got (1.0, 2.0)"),
    ({"preference": [10**400, 0, 0]}, "refused", "preference is no array of numbers"),
    ({"ranges": torch.ones(360, requires_grad=True)}, "refused", "ranges must be numbers"),
    ({"ranges": torch.ones(360).to_sparse()}, "refused", "ranges must be numbers"),
    ({"ranges": np.ones(360, complex)}, "refused", "ranges must be numbers, one a beam: they are"),
    ({"ranges": np.ones(360, bool)}, "refused", "they are bool"),
    ({"ranges": np.ma.masked_all(360)}, "no scan", "the scan has no valid beam"),
    ({"stamp": 10**400}, "clock", "time and stamp must be finite numbers"),
    ({"stamp": True}, "clock", "time and stamp must be finite numbers, got 10.0 and True"),
    ({"stamp": Hostile(KeyError("x"))}, "clock", "got 10.0 and a Hostile"),
    ({"ranges": Hostile(RuntimeError("a driver"))}, "refused", "a driver"),
    ({"ranges": Hostile(KeyError("x"))}, "refused", "KeyError: 'x'"),
    ({"goal": Hostile(ZeroDivisionError("x"))}, "refused", "ZeroDivisionError: x"),
    ({"preference": Hostile(OSError("x"))}, "refused", "OSError: x"),
]
"""The same, of things that are no inputs at all, for a policy that reads the human's velocity."""
