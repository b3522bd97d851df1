"""The qualitative figure: trajectories under a sweep of preferences, three rows by five scenes."""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, Normalize
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from torchrl_morl.evaluation import draw_paths
from torchrl_morl.geometry import rotate

from ..objectives import OBJECTIVES, edge_map
from .files import Evaluation
from .panels import WALK, Column, draw_room, draw_walk, nearest_step, shown
from .quantitative import STYLE

_WIDTH, _HEIGHT = 7.16, 8.8  # of two columns, and of a page with room for a caption, inches
_MARGIN = 0.4
_NARROWEST = 3.4  # metres, so that titles fit


def pick_scenes(evaluation: Evaluation, count: int, *, longest: float = 7.5) -> list[int]:
    """The first scenes whose demonstrated path is free and whose goal is near enough to be seen well.

    Args:
        evaluation: of any system: the scenes are the same for all.
        count: how many.

    Keyword Args:
        longest: distance from start to goal, metres. If there are too few scenes, others follow.
    """
    free = evaluation.values("demonstration_free")[0, 0] == 1
    near = evaluation.values("direct_distance")[0, 0] <= longest
    order = np.argsort(-(2 * free + near).astype(int), kind="stable")
    return order[:count].tolist()


def qualitative_figure(path: Path, columns: list[Column], *, seed: int = 0) -> None:
    """A row for every edge of the preferences, a column for every scene, at the width of a page.

    The robot starts below and drives up. A human who walks is shown where they are when the robot is
    nearest to them under the preference in the middle of the row.

    Args:
        path: file to write.
        columns: at least one, all of the same system.

    Keyword Args:
        seed: place of the training seed that is shown.

    Raises:
        ValueError: without columns, or if the system ignores preferences.
    """
    first = shown(columns)
    objectives, preferences = first.objectives, first.preferences
    steps = first.edge_steps
    edges = range(0, len(preferences), steps)
    drawn = [_upright(column, seed) for column in columns]
    boxes = [_limits(scene) for scene in drawn]
    widths = [right - left for left, right, _, _ in boxes]
    heights = [top - bottom for _, _, bottom, top in boxes]
    tall = max(heights)
    # Inches a metre: what the width gives, unless the page is too short for it.
    scale = min((_WIDTH - 1.6) / sum(widths), (_HEIGHT - 1.0) / len(edges) / tall)
    height = len(edges) * (tall * scale + 0.08) + 0.9
    with plt.rc_context(STYLE):
        fig, axes = plt.subplots(
            len(edges),
            len(columns),
            figsize=(_WIDTH, height),
            width_ratios=widths,
            squeeze=False,
            layout="constrained",
        )
        for line, start in zip(axes, edges):
            ends = preferences[start], preferences[start + steps - 1]
            low, high = (objectives[int(end.argmax())] for end in ends)
            cmap = edge_map(low, high)
            for ax, scene, limits in zip(line, drawn, boxes):
                _draw(ax, scene, slice(start, start + steps), cmap)
                left, right, bottom, top = limits
                middle = (bottom + top) / 2  # equal heights, so that all have one scale
                ax.set_xlim(left, right)
                ax.set_ylim(middle - tall / 2, middle + tall / 2)
                ax.set_xlabel("x / m" if start == edges[-1] else "")
                ax.set_ylabel("y / m" if ax is line[0] else "")
                ax.xaxis.set_major_locator(plt.MultipleLocator(2))
                ax.yaxis.set_major_locator(plt.MultipleLocator(2))
                ax.tick_params(labelbottom=start == edges[-1], length=2, pad=2)
            bar = fig.colorbar(
                ScalarMappable(Normalize(0, 1), cmap), ax=list(line), pad=0.01, aspect=25
            )
            bar.set_ticks(
                [0, 1],
                labels=[OBJECTIVES[low].label, OBJECTIVES[high].label],
                rotation=90,
                va="center",
            )
            bar.ax.tick_params(length=0)
            bar.ax.get_yticklabels()[0].set_va("bottom")
            bar.ax.get_yticklabels()[1].set_va("top")
        for ax, column in zip(axes[0], columns):
            ax.set_title(column.title, fontsize=7)
        fig.legend(handles=_legend(), loc="outside lower center", ncols=4, frameon=False)
        fig.savefig(path, dpi=300)
    plt.close(fig)


def _upright(column: Column, seed: int) -> dict[str, NDArray]:
    """Arrays of one scene, turned so that the goal is above the start; angles turn along."""
    arrays, index, room = column.evaluation.trajectories, column.scene, column.room

    def turned(points: NDArray) -> NDArray:
        points = torch.from_numpy(points.astype(np.float64))
        return rotate(points, torch.full(points.shape[:-1], torch.pi / 2)).numpy()

    def turned_pose(name: str) -> NDArray:
        poses = room[name].astype(np.float64)
        poses[..., :2] = turned(poses[..., :2])
        poses[..., 2] += np.pi / 2
        return poses

    return {
        "position": turned(arrays["position"][seed, :, index]),
        "human": turned(arrays["human"][seed, :, index]),
        "mask": arrays["mask"][seed, :, index],
        "start": turned_pose("start"),
        "goal": turned(room["goal"]),
        "human_start": turned_pose("human_start"),
        "boxes": turned_pose("boxes"),
        "demonstration": turned(room["demonstration"]),
    }


def _limits(scene: dict[str, NDArray]) -> tuple[float, float, float, float]:
    """Left, right, bottom, top of what moves, with a margin."""
    points = np.concatenate(
        [
            scene["position"][scene["mask"]],
            scene["demonstration"],
            scene["human_start"][None, :2],
            scene["goal"][None],
        ]
    )
    (left, bottom), (right, top) = points.min(0) - _MARGIN, points.max(0) + _MARGIN
    more = max(0.0, _NARROWEST - (right - left)) / 2
    return left - more, right + more, bottom, top


def _draw(ax: plt.Axes, scene: dict[str, NDArray], rows: slice, cmap: Colormap) -> None:
    middle = (rows.start + rows.stop) // 2
    robot, human = (scene[name][middle][scene["mask"][middle]] for name in ("position", "human"))
    place = human[nearest_step(robot, human)]
    draw_room(ax, scene, human=np.append(place, scene["human_start"][2]), marker_scale=0.5)
    longest = rows.start + int(scene["mask"][rows].sum(1).argmax())
    draw_walk(ax, scene["human"][longest][scene["mask"][longest]])
    values = np.linspace(0, 1, rows.stop - rows.start)
    draw_paths(ax, scene["position"][rows], scene["mask"][rows], values, cmap=cmap, linewidth=0.9)
    ax.plot(*scene["demonstration"].T, **_DEMONSTRATION, zorder=3.5)


_DEMONSTRATION = {"color": "black", "linewidth": 1.0, "dashes": (4, 1.5)}


def _legend() -> list[Line2D]:
    """What is not coloured by preference."""
    dot = {"linestyle": "", "markeredgecolor": "black", "markersize": 5}
    return [
        Line2D([], [], **_DEMONSTRATION, label="demonstration"),
        Line2D([], [], marker="o", color="white", **dot, label="human, when nearest"),
        Line2D([], [], **WALK, label="way of the human"),
        Line2D([], [], marker="*", color="black", linestyle="", markersize=6, label="goal"),
    ]
