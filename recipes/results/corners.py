"""One policy at the corners of the preferences, scene beside scene: is each wish told from the others?

Example::

    python -m recipes.results.evaluate OUR=recipes/policies/navigation --output runs/results
    python -m recipes.results.corners runs/results
    python -m recipes.results.corners runs/results --condition crossing towards --count 5
"""

from __future__ import annotations

import math
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from ..arguments import Parser, positive_int
from ..objectives import OBJECTIVES
from .files import Evaluation, read_evaluation
from .panels import Column, draw_room, draw_walk, nearest_step, shown
from .quantitative import STYLE

_COLUMNS = 5
_PANEL = 2.6  # inches
_MARGIN = 0.6  # metres


def corners_figure(path: Path, columns: list[Column], *, seed: int = 0) -> None:
    """A panel a scene, with the path at each corner preference in the colour of its objective.

    The human is drawn where they are at the beginning, a dotted line is their way, and a dot on both
    ways marks the moment at which the two are nearest. A cross is where an episode fails.

    Args:
        path: file to write.
        columns: scenes of evaluations of the same system.

    Keyword Args:
        seed: place of the training seed that is shown.

    Raises:
        ValueError: without scenes, or if the system ignores preferences.
    """
    first = shown(columns)
    across = min(_COLUMNS, len(columns))
    down = math.ceil(len(columns) / across)
    with plt.rc_context(STYLE):
        fig, axes = plt.subplots(
            down,
            across,
            figsize=(_PANEL * across, _PANEL * down + 0.4),
            squeeze=False,
            layout="constrained",
        )
        for ax, column in zip(axes.flat, columns, strict=False):
            _panel(ax, column, seed)
        for ax in axes.flat[len(columns) :]:
            ax.axis("off")
        fig.legend(
            handles=_legend(first), loc="outside lower center", ncols=8, frameon=False, fontsize=9
        )
        fig.savefig(path, dpi=110)
    plt.close(fig)


def _panel(ax: plt.Axes, column: Column, seed: int) -> None:
    evaluation, index, room = column.evaluation, column.scene, column.room
    arrays = evaluation.trajectories
    success = evaluation.values("success")
    moves = [room["start"][None, :2], room["goal"][None]]
    draw_room(ax, room, marker_scale=0.6)
    ax.plot(*room["demonstration"].T, color="0.6", linewidth=3.0, zorder=1.5)
    for name in evaluation.objectives:
        row = evaluation.corner(name)
        mask = arrays["mask"][seed, row, index]
        robot, human = (arrays[key][seed, row, index][mask] for key in ("position", "human"))
        color = OBJECTIVES[name].color
        ax.plot(*robot.T, color=color, linewidth=1.6, zorder=4)
        if draw_walk(ax, human):
            nearest = nearest_step(robot, human)
            for points in (robot, human):
                ax.plot(*points[nearest], "o", color=color, markersize=4, zorder=5)
        if not success[seed, row, index]:
            ax.plot(*robot[-1], "x", color=color, markersize=8, markeredgewidth=2, zorder=6)
        moves.append(robot)
    _frame(ax, np.concatenate(moves))
    ax.set_title(column.title, fontsize=9)


def _frame(ax: plt.Axes, points: NDArray) -> None:
    """A square around what moves."""
    low, high = points.min(0), points.max(0)
    half = max(high - low) / 2 + _MARGIN
    (x, y) = (low + high) / 2
    ax.set(xlim=(x - half, x + half), ylim=(y - half, y + half), aspect="equal")
    ax.set(xticks=[], yticks=[], xlabel="", ylabel="")


def _legend(evaluation: Evaluation) -> list[Line2D]:
    lines = [
        Line2D([], [], color=OBJECTIVES[name].color, linewidth=1.6, label=OBJECTIVES[name].label)
        for name in evaluation.objectives
    ]
    cross = {"marker": "x", "linestyle": "", "color": "black"}
    return [
        *lines,
        Line2D([], [], color="0.6", linewidth=3.0, label="what was demonstrated"),
        Line2D([], [], **cross, label="fails"),
    ]


def main() -> None:
    """Draw the figure; ``--help`` lists the options."""
    parser = Parser(description=__doc__)
    parser.add_argument("directory", type=Path, help="what recipes.results.evaluate wrote")
    parser.add_argument("--system", default="OUR", help="whose paths")
    parser.add_argument("--condition", nargs="+", default=["static"], help="one or several")
    parser.add_argument("--count", type=positive_int, default=10, help="scenes of each, the first")
    args = parser.parse_args()
    path = args.directory / f"{args.system}_corners.png"
    try:
        columns = []
        for condition in args.condition:
            evaluation = read_evaluation(args.directory / args.system / condition)
            for scene in range(min(args.count, evaluation.summary["episodes"])):
                title = f"{condition.replace('_', ' ')} ({scene})"
                columns.append(Column(evaluation, scene, title))
        corners_figure(path, columns)
    except (FileNotFoundError, ValueError) as error:
        parser.error(str(error))
    print(f"written: {path}")


if __name__ == "__main__":
    main()
