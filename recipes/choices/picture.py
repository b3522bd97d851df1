"""Two drives side by side, and the drives that were chosen."""

from __future__ import annotations

import math
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.lines import Line2D

from envs import HUMAN_RADIUS, NavigationEnv
from torchrl_morl.evaluation import draw_scene

from ..evaluation.sweep import Sweep
from ..objectives import preference_colors

SIDES = ("#0072b2", "#d55e00")
"""Left and right: blue and vermilion, which no kind of colour blindness confuses."""

_EVERY = 2.0
_STYLE = {"font.size": 11, "axes.titlesize": 13}


def question_picture(
    path: Path, result: Sweep, scene: int, pair: tuple[int, int], *, goal_radius: float, title: str
) -> Path:
    """Draw two drives of one scene; a dot every two seconds shows how fast they are.

    Args:
        path: file to write.
        result: the drives.
        scene: index of the scene.
        pair: which preferences, left and right.

    Keyword Args:
        goal_radius: metres.
        title: above both.
    """
    with plt.rc_context(_STYLE):
        fig, axes = plt.subplots(1, 2, figsize=(13, 6.2), sharex=True, sharey=True)
        for side, (ax, row) in enumerate(zip(axes, pair, strict=True)):
            _scene(ax, result, scene, goal_radius)
            _drive(ax, result, scene, row, SIDES[side])
            ax.set_title(f"{side + 1}", color=SIDES[side], fontweight="bold", fontsize=22)
            ax.set_xlabel(_numbers(result, scene, row))
            ax.tick_params(labelbottom=True)
        axes[1].set_ylabel("")
        fig.suptitle(title, fontsize=14)
        fig.legend(handles=_legend(), loc="lower center", ncols=5, frameon=False)
        fig.tight_layout(rect=(0, 0.07, 1, 1))
        fig.savefig(path, dpi=90)
    plt.close(fig)
    return path


def chosen_picture(
    path: Path, result: Sweep, index: int, *, goal_radius: float, title: str, scenes: int = 4
) -> Path:
    """Draw what a preference does in some scenes, in its colour, among all others in grey.

    Args:
        path: file to write.
        result: the drives.
        index: of the preference.

    Keyword Args:
        goal_radius: metres.
        title: above all.
        scenes: how many, the first ones.
    """
    names = result.preference_space.tunable
    color = tuple(preference_colors(result.preferences[index][None], names)[0])
    scenes = min(scenes, len(result.scenes))
    with plt.rc_context(_STYLE):
        fig, axes = plt.subplots(
            -(-scenes // 2), 2, figsize=(13, 4.4 * -(-scenes // 2)), squeeze=False
        )
        for ax in axes.flat[scenes:]:
            ax.set_axis_off()
        for scene, ax in zip(range(scenes), axes.flat, strict=False):
            for row in range(0, len(result.preferences), 5):
                position = _path(result, scene, row)
                ax.plot(*position.T, color="0.82", linewidth=1, zorder=1)
            _scene(ax, result, scene, goal_radius)
            _drive(ax, result, scene, index, color)
            ax.set_xlabel(_numbers(result, scene, index))
        fig.suptitle(title, fontsize=14)
        fig.legend(handles=_legend(), loc="lower center", ncols=5, frameon=False)
        fig.tight_layout(rect=(0, 0.04, 1, 1))
        fig.savefig(path, dpi=90)
    plt.close(fig)
    return path


def _path(result: Sweep, scene: int, row: int) -> np.ndarray:
    paths = result.paths[row, scene]
    return np.asarray(paths["position"][paths["mask"]])


def _scene(ax: plt.Axes, result: Sweep, scene: int, goal_radius: float) -> None:
    layout = result.scenes[scene]
    draw_scene(ax, **layout, human_radius=HUMAN_RADIUS, goal_radius=goal_radius)
    if result.demonstration is not None:
        shown = result.demonstration[scene]
        points = np.asarray(shown["position"][shown["mask"]])
        ax.plot(*points.T, color="black", linewidth=1.1, dashes=(4, 2), zorder=2)
    # Of all preferences: no drive is cut, and both sides of a question have the same.
    paths = result.paths[:, scene]
    points = np.asarray(paths["position"][paths["mask"]])
    low, high = points.min(0) - 0.8, points.max(0) + 0.8
    ax.set_xlim(low[0], high[0])
    ax.set_ylim(min(low[1], -2.2), max(high[1], 2.2))


def _drive(ax: plt.Axes, result: Sweep, scene: int, row: int, color: object) -> None:
    position = _path(result, scene, row)
    step = round(_EVERY / NavigationEnv.CONTROL_PERIOD)
    ax.plot(*position.T, color=color, linewidth=2.6, zorder=3)
    ax.plot(*position[::step].T, "o", color=color, markersize=6, zorder=3.5)


def _numbers(result: Sweep, scene: int, row: int) -> str:
    metrics = result.metrics[row, scene]
    if not bool(metrics["success"]):
        return "does not arrive"
    text, nearest = f"{float(metrics['time']):.0f} s", float(metrics["min_human_distance"])
    if not math.isnan(nearest):  # nobody is there
        text += f", at least {nearest:.1f} m away"
    if "frechet" in metrics.keys():
        text += f", {float(metrics['frechet']):.1f} m from what was shown"
    return text


def _legend() -> list[Line2D]:
    dot = {"linestyle": "", "color": "black"}
    return [
        Line2D([], [], marker="o", label="start; a dot every 2 s", **dot),
        Line2D([], [], marker="*", markersize=12, label="goal", **dot),
        Line2D([], [], marker="o", markersize=11, markerfacecolor="white", label="person", **dot),
        Line2D([], [], color="black", dashes=(4, 2), label="what was shown"),
    ]
