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
