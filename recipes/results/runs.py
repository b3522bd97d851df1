"""One summary of many trainings: interquartile mean over seeds with its interval, for every setting that was run.

Example::

    python -m recipes.benchmark.train --multirun seed=0,1,2,3,4 env=mo-hopper-v5 hydra.sweep.dir=runs/hopper
    python -m recipes.results.runs runs/hopper --output runs/hopper/summary.csv

Reads what the trainings wrote into the cards of their policies: of run folders, and of the runs in the folder of a
multirun. Runs that differ in nothing but the seed are one setting.
"""

from __future__ import annotations

import csv
import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, get_args

import yaml

from torchrl_morl.evaluation import Interval, bootstrap_interval

from ..arguments import Parser, existing_folder
from ..outputs import check_new_file

Choice = Literal["last", "best"]
_TOLD_APART = ("seed=", "resume=", "hydra.")
"""Beginnings of overrides that make no other setting."""


@dataclasses.dataclass(frozen=True)
class Run:
    """A training and what one of its policies reached.

    Args:
        folder: where it lies.
        setting: its overrides but for the seed, sorted.
        steps: after which the policy was saved.
        metrics: of its evaluation, by name.
    """

    folder: Path
    setting: tuple[str, ...]
    steps: int
    metrics: dict[str, float]


def read_run(folder: Path, choice: Choice = "last") -> Run:
    """Read a run folder.

    Args:
        folder: that a training wrote.
        choice: of the policy: the last one, or that with the best score.

    Raises:
        ValueError: in one line, if it holds no policy or something else.
    """
    cards = {}
    for file in sorted(folder.glob("policies/[!.]*/policy.json")):
        try:
            card = json.loads(file.read_text(encoding="utf-8"))["card"]
            cards[int(file.parent.name)] = (float(card["score"]), metrics_of(card))
        except (
            ValueError,
            LookupError,
            TypeError,
            AttributeError,
            OSError,
            RecursionError,
        ) as error:
            raise ValueError(f"{file} is no card of a training: {error!r}") from error
    if not cards:
        raise ValueError(f"{folder} holds no policy: the training has not been evaluated yet.")
    steps = max(cards, key=(lambda one: (cards[one][0], one)) if choice == "best" else None)
    return Run(folder, _setting(folder), steps, cards[steps][1])


def metrics_of(card: Mapping[str, Any]) -> dict[str, float]:
    """The metrics of a policy's card, those of the navigation recipes one for each preference.

    Examples:
        >>> metrics_of({"score": 1.0, "evaluation": {"preferences": ["demo"], "success": [98.0]}})
        {'score': 1.0, 'success/demo': 98.0}
        >>> metrics_of({"score": 1.0, "metrics": {"eval/hypervolume": 2.0}})
        {'score': 1.0, 'hypervolume': 2.0}
    """
    found = {"score": card["score"]}
    for name, value in card.get("metrics", {}).items():
        found[name.removeprefix("eval/")] = value
    evaluation = card.get("evaluation", {})
    for column, values in evaluation.items():
        if column != "preferences":
            for preference, value in zip(evaluation["preferences"], values, strict=True):
                found[f"{column}/{preference}"] = value
    # JSON knows no NaN: cards hold null.
    return {name: math.nan if value is None else float(value) for name, value in found.items()}


def _setting(folder: Path) -> tuple[str, ...]:
    file = folder / ".hydra" / "overrides.yaml"
    try:
        overrides = yaml.safe_load(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError, yaml.YAMLError) as error:
        raise ValueError(f"{file} cannot be read: {str(error).splitlines()[0]}") from error
    if not isinstance(overrides, list) or not all(isinstance(one, str) for one in overrides):
        raise ValueError(f"{file} is no list of overrides.")
    return tuple(sorted(one for one in overrides if not one.startswith(_TOLD_APART)))


def find_runs(folders: Sequence[Path]) -> list[Path]:
    """The run folders among these, and those in folders of multiruns, in their order.

    Raises:
        ValueError: for a folder that is neither.
    """
    found = []
    for folder in folders:
        inside = [folder] if (folder / ".hydra").is_dir() else []
        inside += [path.parent for path in folder.glob("*/.hydra") if path.is_dir()]
        if not inside:
            raise ValueError(f"{folder} is no run, and none is in it: give folders of trainings.")
        found += sorted(inside, key=lambda path: (len(path.name), path.name))
    return found


def summarize(runs: Sequence[Run]) -> dict[tuple[str, ...], dict[str, Interval]]:
    """Interquartile means over the seeds of each setting, with bootstrap intervals.

    Args:
        runs: of one recipe.

    Returns:
        For each setting, in the order of the runs, every metric that all of its runs have.
    """
    settings: dict[tuple[str, ...], list[Run]] = {}
    for run in runs:
        settings.setdefault(run.setting, []).append(run)
    summary = {}
    for setting, members in settings.items():
        first = members[0].metrics
        names = [name for name in first if all(name in one.metrics for one in members)]
        summary[setting] = {
            name: bootstrap_interval([one.metrics[name] for one in members], statistic="iqm")
            for name in names
        }
    return summary


def table(summary: Mapping[tuple[str, ...], Mapping[str, Interval]]) -> str:
    """As Markdown: a row a metric, a column a setting; what all settings share is left out of the titles."""
    shared = set.intersection(*map(set, summary))
    titles = [
        " ".join(one for one in setting if one not in shared) or "all runs" for setting in summary
    ]
    counts = [max(one.n for one in found.values()) for found in summary.values()]
    names = list(dict.fromkeys(name for found in summary.values() for name in found))
    lines = [
        "| metric | " + " | ".join(f"{t}, n = {n}" for t, n in zip(titles, counts)) + " |",
        "|---|" + "---|" * len(titles),
    ]
    for name in names:
        cells = (_cell(found.get(name)) for found in summary.values())
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _cell(interval: Interval | None) -> str:
    if interval is None or math.isnan(interval.estimate):
        return "-"
    if math.isnan(interval.low):
        return f"{interval.estimate:.5g}"
    return f"{interval.estimate:.5g} [{interval.low:.5g}, {interval.high:.5g}]"


def write(summary: Mapping[tuple[str, ...], Mapping[str, Interval]], path: Path) -> None:
    """As CSV: a row for each metric of each setting."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("x", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["setting", "metric", "n", "iqm", "low", "high"])
        for setting, found in summary.items():
            for name, one in found.items():
                numbers = (f"{value:.9g}" for value in (one.estimate, one.low, one.high))
                writer.writerow([" ".join(setting), name, one.n, *numbers])


def main(arguments: list[str] | None = None) -> None:
    """Summarize; ``--help`` lists the options."""
    parser = Parser(description=__doc__)
    parser.add_argument(
        "runs", type=existing_folder, nargs="+", help="folders of trainings, or of a multirun"
    )
    parser.add_argument(
        "--policy",
        choices=get_args(Choice),
        default="last",
        help="of each training: the last one (default), or that with the best score, which flatters",
    )
    parser.add_argument("--output", type=Path, help="CSV file to write")
    args = parser.parse_args(arguments)
    runs, left_out = [], []
    try:
        if args.output is not None:
            check_new_file(args.output)
        for folder in find_runs(args.runs):
            if any(folder.glob("policies/[!.]*")):
                runs.append(read_run(folder, args.policy))
            else:
                left_out.append(folder)
        if not runs:
            raise ValueError(f"{left_out[0]} holds no policy: no run has been evaluated yet.")
        summary = summarize(runs)
        print(
            "Interquartile mean over seeds [95 % bootstrap interval], which few seeds make too narrow.\n"
        )
        print(table(summary))
        if args.output is not None:
            write(summary, args.output)
            print(f"\nwritten to {args.output}")
    except (ValueError, OSError) as error:
        parser.error(str(error))
    for folder in left_out:
        print(f"\nwarning: {folder} holds no policy and is left out.")
    if args.policy == "last" and len({run.steps for run in runs}) > 1:
        steps = ", ".join(f"{run.steps:,}" for run in runs)
        print(f"\nwarning: the policies are of different steps: {steps}.")


if __name__ == "__main__":
    main()
