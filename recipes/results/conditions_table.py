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
import torch

from envs import HUMAN_RADIUS
from envs.people import FAR
from torchrl_morl.evaluation import draw_scene

from ..arguments import Parser, count
from ..evaluation.setting import GOAL_RADIUS
from ..outputs import choose_file
from .conditions import CHANGES, SCENE_KINDS
from .files import SUMMARY, Evaluation, read_evaluation
from .table import markdown

_HEADER = ["condition", "success / %", "touches people / %", "touches boxes / %", "timeouts / %"]
_RATES = ("success", "collision_human", "collision_obstacle", "timeout")
_COLUMNS = 4
_FAILURE_COLOURS = {"collision_human": "#d62728", "collision_obstacle": "#ff7f0e", "timeout": "0.4"}


def read_system(directory: Path, system: str) -> dict[str, Evaluation]:
    """Evaluations of a system by condition, in the order of the conditions' list.

    Raises:
        FileNotFoundError: if there is none.
    """
    folders = {
        path.parent.name: path.parent for path in directory.glob(f"{system}/[!.]*/{SUMMARY}")
    }
    if not folders:
        raise FileNotFoundError(
            f"No evaluation of {system!r} in {directory}: python -m recipes.results.evaluate makes them."
        )
    known = [*SCENE_KINDS, *CHANGES]
    order = sorted(folders, key=lambda name: (known.index(name) if name in known else 999, name))
    return {name: read_evaluation(folders[name]) for name in order}


def conditions_table(evaluations: dict[str, Evaluation]) -> str:
    """A row a condition: rates in percent, success with its 95 % interval."""
    rows = []
    for name, evaluation in evaluations.items():
        rates = [evaluation.summary["rates"][rate] for rate in _RATES]
        success = rates[0]
        cells = [
            f"{100 * success['estimate']:.1f} [{100 * success['low']:.1f}, {100 * success['high']:.1f}]"
        ]
        cells += [f"{100 * rate['estimate']:.1f}" for rate in rates[1:]]
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
    shown = [name for name in sorted(share, key=share.get, reverse=True) if share[name] > 0][
        :panels
    ]
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
        plt.Line2D([], [], color=colour, label=label)
        for colour, label in zip(
            _FAILURE_COLOURS.values(), ("touches a person", "touches a box", "out of time")
        )
    ]
    fig.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False)
    fig.savefig(path, dpi=110)
    plt.close(fig)
    return shown


def _draw_failures(axis: plt.Axes, evaluation: Evaluation) -> None:
    """The scene in which most preferences fail: the failed paths, and who walked where."""
    failed = evaluation.values("success")[0] == 0
    scene = int(failed.sum(0).argmax())
    arrays = evaluation.trajectories
    boxes = arrays["boxes"][scene]
    still = {name: torch.from_numpy(arrays[name][scene]) for name in ("start", "goal")}
    draw_scene(
        axis,
        **still,
        human=torch.from_numpy(arrays["human_start"][scene]),
        boxes=torch.from_numpy(boxes[boxes[:, 0] < FAR / 2]),
        human_radius=HUMAN_RADIUS,
        goal_radius=GOAL_RADIUS,
    )
    places = [still["start"][None, :2].numpy(), still["goal"][None].numpy()]
    for row in np.flatnonzero(failed[:, scene]):
        mask = arrays["mask"][0, row, scene]
        path, human = (arrays[name][0, row, scene][mask] for name in ("position", "human"))
        cause = next(name for name in _FAILURE_COLOURS if evaluation.values(name)[0, row, scene])
        colour = _FAILURE_COLOURS[cause]
        axis.plot(*path.T, color=colour, linewidth=1.2)
        axis.plot(*path[-1], "o", color=colour, markersize=4)
        places.append(path)
        if abs(human[-1, 0]) < FAR / 2:
            places.append(human[-1:])
            axis.plot(*human.T, color="0.35", linestyle=":", linewidth=1.0)
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
