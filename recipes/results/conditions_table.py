"""The table of all conditions from the evaluations in a folder, and a page of pictures of what fails.

Example::

    python -m recipes.results.conditions_table runs/all

Rates are over all preferences; intervals are over scenes, since preferences share them. The page shows,
for the conditions in which a system fails most, the paths that do not arrive.
"""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np

from envs import HUMAN_RADIUS
from envs.people import FAR

from ..arguments import Parser, count
from ..outputs import choose_file
from .conditions import CHANGES, SCENE_KINDS
from .files import SUMMARY, Evaluation, read_evaluation
from .panels import Column, draw_room, draw_walk
from .table import markdown

_HEADER = ["condition", "success / %", "touches people / %", "touches boxes / %", "timeouts / %"]
_RATES = ("success", "collision_human", "collision_obstacle", "timeout")
_COLUMNS = 4
_FAILURES = {
    "collision_human": ("touches a person", "#d62728"),
    "collision_obstacle": ("touches a box", "#ff7f0e"),
    "timeout": ("out of time", "0.4"),
}


def read_system(directory: Path, system: str) -> dict[str, Evaluation]:
    """Evaluations of a system by condition, in the order of the conditions' list.

    Raises:
        FileNotFoundError: if there is none.
    """
    names = {path.parent.name for path in (directory / system).glob(f"[!.]*/{SUMMARY}")}
    if not names:
        raise FileNotFoundError(
            f"No evaluation of {system!r} in {directory}: python -m recipes.results.evaluate makes them."
        )
    known = {name: place for place, name in enumerate([*SCENE_KINDS, *CHANGES])}
    order = sorted(names, key=lambda name: (known.get(name, len(known)), name))
    return {name: read_evaluation(directory / system / name) for name in order}


def conditions_table(evaluations: dict[str, Evaluation]) -> str:
    """A row a condition: rates in percent, success with its 95 % interval."""
    rows = []
    for name, evaluation in evaluations.items():
        rates = evaluation.summary["rates"]
        cells = [f"{100 * rates[rate]['estimate']:.1f}" for rate in _RATES]
        low, high = (100 * rates["success"][end] for end in ("low", "high"))
        cells[0] += f" [{low:.1f}, {high:.1f}]"
        rows.append([f"`{name}`", *cells])
    return markdown(_HEADER, rows)


def failures_page(path: Path, evaluations: dict[str, Evaluation], panels: int) -> list[str]:
    """Draw failed paths of the conditions that fail most, one scene each.

    Args:
        path: file to write.
        evaluations: of one system, by condition.
        panels: how many at most.

    Returns:
        The conditions that are shown; nothing is written if nothing fails.
    """
    share = {name: 1 - one.values("success").mean() for name, one in evaluations.items()}
    failing = [name for name in sorted(share, key=share.get, reverse=True) if share[name] > 0]
    shown = failing[:panels]
    if not shown:
        return []
    lines = -(-len(shown) // _COLUMNS)
    fig, axes = plt.subplots(
        lines, _COLUMNS, figsize=(13, 3.0 * lines), squeeze=False, layout="constrained"
    )
    for axis in axes.flat[len(shown) :]:
        axis.set_visible(False)
    for axis, name in zip(axes.flat, shown):
        _draw_failures(axis, evaluations[name])
        axis.set_title(f"{name}: {100 * share[name]:.0f} % do not arrive", fontsize=9)
    handles = [
        plt.Line2D([], [], color=colour, label=label) for label, colour in _FAILURES.values()
    ]
    fig.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False)
    fig.savefig(path, dpi=110)
    plt.close(fig)
    return shown


def _draw_failures(axis: plt.Axes, evaluation: Evaluation) -> None:
    """The training seed and scene in which most preferences fail: those paths, and who walked where."""
    failed = evaluation.values("success") == 0
    seed, scene = divmod(int(failed.sum(1).argmax()), failed.shape[-1])
    arrays, room = evaluation.trajectories, Column(evaluation, scene, "").room
    draw_room(axis, room)
    places = [room["start"][None, :2], room["goal"][None]]
    for row in np.flatnonzero(failed[seed, :, scene]):
        episode = seed, row, scene
        mask = arrays["mask"][episode]
        path, human = (arrays[name][episode][mask] for name in ("position", "human"))
        cause = next(name for name in _FAILURES if evaluation.values(name)[episode])
        _, colour = _FAILURES[cause]
        axis.plot(*path.T, color=colour, linewidth=1.2)
        axis.plot(*path[-1], "o", color=colour, markersize=4)
        places.append(path)
        if abs(human[-1, 0]) < FAR / 2:
            places.append(human[-1:])
            draw_walk(axis, human)
            axis.add_patch(plt.Circle(human[-1], HUMAN_RADIUS, color="black", alpha=0.6))
    low, high = (edge(np.concatenate(places), axis=0) for edge in (np.min, np.max))
    axis.set_xlim(low[0] - 1, high[0] + 1)
    axis.set_ylim(low[1] - 1.5, high[1] + 1.5)
    axis.tick_params(labelsize=7)


def main() -> None:
    """Print and write; ``--help`` lists the options."""
    parser = Parser(description=__doc__)
    parser.add_argument("directory", type=Path, help="what recipes.results.evaluate wrote")
    parser.add_argument("--system", nargs="+", help="default: all that are there")
    parser.add_argument("--panels", type=count(1, 100), default=16, help="pictures on the page")
    args = parser.parse_args()
    names = args.system or sorted(
        {path.parents[1].name for path in args.directory.glob(f"[!.]*/[!.]*/{SUMMARY}")}
    )
    try:
        systems = {name: read_system(args.directory, name) for name in names}
        if not systems:
            raise FileNotFoundError(f"No evaluation in {args.directory}.")
        pages = {
            name: choose_file(None, args.directory / f"failures_{name}.png") for name in systems
        }
    except (OSError, ValueError) as error:
        parser.error(str(error))
    for name, evaluations in systems.items():
        print(f"## {name}\n\n{conditions_table(evaluations)}\n")
        if failures_page(pages[name], evaluations, args.panels):
            print(f"what fails: {pages[name]}\n")


if __name__ == "__main__":
    main()
