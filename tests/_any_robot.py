"""A policy that reads all that one can: which robot it drives, the human's velocity and a mark for nobody."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from tests import _restless
from torchrl_morl.deploy import LidarGeometry, Sensing

OBSERVED = {"observe_human_velocity": True, "observe_nobody": True, "observe_robot": True}
SENSING = Sensing(**OBSERVED)
ROBOT = (0.25, 0.7, 2.0, 4.7, 8.0, 0.1)

TOO_MUCH = (
    ((250.0, 0.7, 2.0, 4.7, 8.0, 0.1), "the radius must be at most 2 m, got 250"),
    ((0.25, 700.0, 2.0, 4.7, 8.0, 0.1), "the top speed must be at most 10 m/s, got 700"),
    ((0.25, 0.7, 90.0, 4.7, 8.0, 0.1), "the top turn rate must be at most 12.6 rad/s, got 90"),
    ((0.25, 0.7, 2.0, 270.0, 8.0, 0.1), "the view of the lidar must be at most 6.3 rad, got 270"),
    ((0.25, 0.7, 2.0, 4.7, 8000.0, 0.1), "the range of the lidar must be at most 100 m, got 8000"),
    ((0.25, 0.7, 2.0, 4.7, 8.0, -0.3), "the lidar must be within the radius of 0.25 m, got -0.3"),
)
"""Robots in other units, and what is said of them."""
LIDAR = LidarGeometry(0.0, math.pi / 90, 180, 0.05, 8.0, (ROBOT[-1], 0.0, 0.0))


def save(
    folder: Path,
    robot: str = "any",
    *,
    scene: str = "static",
    seed: int = 1,
    motion: bool = False,
    **card: Any,
) -> Path:
    """Nobody has trained it; it turns this way and that, by all that it reads.

    Args:
        folder: new.
        robot: name of the one that it was trained with, or ``"any"``.

    Keyword Args:
        scene: of its training and its evaluations.
        seed: of its weights.
        motion: whether it reads how the robot moves, too.
        **card: more of its card.
    """
    trained = {"scene": scene, "robot": robot, **OBSERVED, "observe_motion": motion}
    return _restless.save(folder, trained, seed=seed, **card)
