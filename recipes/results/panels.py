"""What the pictures of evaluated scenes share: which scene, what stands in it, and who walks there."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray

from envs import HUMAN_RADIUS
from torchrl_morl.evaluation import draw_scene

from ..evaluation.setting import GOAL_RADIUS
from .files import Evaluation

WALK = {"color": "0.35", "linestyle": ":", "linewidth": 1.2}
"""The line of a human who walks."""

_STANDS = 0.1
"""Of one who stands, metres of way at most."""


@dataclasses.dataclass(frozen=True)
class Column:
    """A scene of an evaluation.

    Args:
        evaluation: under one condition.
        scene: its index.
        title: above it.
    """

    evaluation: Evaluation
    scene: int
    title: str

    @property
    def room(self) -> dict[str, NDArray]:
        """``start`` [3], ``goal`` [2], ``human_start`` [3], ``boxes`` [M, 5], ``demonstration`` [D, 2]."""
        arrays = self.evaluation.trajectories
        names = ("start", "goal", "human_start", "boxes", "demonstration", "demonstration_mask")
        room = {name: arrays[name][self.scene] for name in names}
        room["demonstration"] = room["demonstration"][room.pop("demonstration_mask")]
        return room


def shown(columns: list[Column]) -> Evaluation:
    """The evaluation of the first column, of a system that follows preferences.

    Raises:
        ValueError: without columns, or if the system ignores preferences.
    """
    if not columns:
        raise ValueError("No scenes to show.")
    evaluation = columns[0].evaluation
    if evaluation.summary["ignores_preference"]:
        raise ValueError(f"{evaluation.system} ignores preferences: nothing to show over them.")
    return evaluation


def draw_room(
    ax: plt.Axes,
    room: Mapping[str, NDArray],
    *,
    human: NDArray | None = None,
    marker_scale: float = 1.0,
) -> None:
    """Draw start, goal, human and boxes.

    Args:
        ax: axes in metres.
        room: of a column.

    Keyword Args:
        human: ``[3]``; ``None`` is where they are at the beginning.
        marker_scale: see :func:`~torchrl_morl.evaluation.draw_scene`.
    """
    draw_scene(
        ax,
        start=room["start"],
        goal=room["goal"],
        human=room["human_start"] if human is None else human,
        boxes=room["boxes"],
        human_radius=HUMAN_RADIUS,
        goal_radius=GOAL_RADIUS,
        marker_scale=marker_scale,
    )


def draw_walk(ax: plt.Axes, human: NDArray) -> bool:
    """Draw the way ``[T, 2]`` of a human who walks. Returns whether they do."""
    walks = bool(np.ptp(human, axis=0).max() > _STANDS)
    if walks:
        ax.plot(*human.T, **WALK, zorder=2)
    return walks


def nearest_step(robot: NDArray, human: NDArray) -> int:
    """Step at which the two, ``[T, 2]`` each, are nearest."""
    return int(np.linalg.norm(robot - human, axis=-1).argmin())
