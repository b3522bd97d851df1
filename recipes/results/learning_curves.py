"""What a training reaches after which time: success and style, one line a training seed.

Example::

    python -m recipes.results.learning_curves runs/seed0 runs/seed1 runs/seed2 --output curves.png

Reads the TensorBoard log of each run folder of ``recipes.pd_morl``, whose evaluations are of fixed scenes. The clock
starts with the log, after imports and before the compilation of the losses, and runs during evaluations.
"""

from __future__ import annotations

import textwrap
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from ..arguments import Parser
from ..objectives import OBJECTIVES

PANELS = {
    "eval/success": "success, %",
    **{f"eval/{one.column}/{one.name}": one.metric_label for one in OBJECTIVES.values()},
}
"""Labels of what is drawn, by its name in the log; objectives that no run has are left out."""

Curves = dict[str, tuple[list[float], list[float]]]
"""Minutes and values of each panel."""


def read_run(folder: Path) -> Curves:
    """The evaluations of a training.

    Args:
        folder: run folder of ``recipes.pd_morl``.

    Raises:
        FileNotFoundError: if it has no TensorBoard log with evaluations.
    """
    log = EventAccumulator(str(folder / "log_tensorboard"))
    if (folder / "log_tensorboard").is_dir():
        log.Reload()
    tags = log.Tags()["scalars"]
    if "eval/success" not in tags:
        raise FileNotFoundError(
            f"{folder} has no evaluations in log_tensorboard: give run folders of recipes.pd_morl "
            "with the tensorboard backend among logger.backends."
        )
    start = log.FirstEventTimestamp()
    curves = {}
    for tag in PANELS:
        events = log.Scalars(tag) if tag in tags else []
        minutes = [(event.wall_time - start) / 60 for event in events]
        curves[tag] = minutes, [event.value for event in events]
    return curves


def draw(runs: dict[str, Curves], path: Path) -> None:
    """One panel a metric, one line a run.

    Raises:
        FileExistsError: if there is a file at ``path``.
    """
    if path.exists():
        raise FileExistsError(f"{path} exists and is not overwritten: choose another --output.")
    shown = {
        tag: label
        for tag, label in PANELS.items()
        if any(values for curves in runs.values() for values in curves[tag])
    }
    figure, axes = pyplot.subplots(
        1, len(shown), figsize=(3.2 * len(shown), 3), layout="constrained", squeeze=False
    )
    for axis, (tag, label) in zip(axes[0], shown.items(), strict=True):
        for name, curves in runs.items():
            axis.plot(*curves[tag], label=name)
        axis.set(xlabel="minutes of training", ylabel=textwrap.fill(label, 28))
        # The first evaluations, of a policy that can do nothing yet, would squeeze all others.
        later = [value for curves in runs.values() for value in curves[tag][1][3:]]
        if later:
            margin = 0.1 * (max(later) - min(later)) or 1.0
            axis.set_ylim(min(later) - margin, max(later) + margin)
        axis.grid(alpha=0.3)
    axes[0, 0].legend()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)
    pyplot.close(figure)


def main(arguments: list[str] | None = None) -> None:
    """Draw; ``--help`` lists the options."""
    parser = Parser(description=__doc__)
    parser.add_argument("runs", type=Path, nargs="+", help="run folders of recipes.pd_morl")
    parser.add_argument("--output", type=Path, required=True, help="picture to write")
    args = parser.parse_args(arguments)
    try:
        draw({folder.name: read_run(folder) for folder in args.runs}, args.output)
    except (FileExistsError, FileNotFoundError) as error:
        parser.error(str(error))
    print(f"written to {args.output}")


if __name__ == "__main__":
    main()
