"""The front of a training, or of several: a picture, and hypervolume, expected utility and the rest as a table.

Example::

    python -m recipes.benchmark.front runs/benchmark/seed0 runs/benchmark/seed1 --output front.png

Reads ``front.csv`` of run folders of ``recipes.benchmark.train``; of a multirun's folder that of every run in it.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import yaml

from ..arguments import Parser, existing_folder
from ..outputs import check_new_file
from .fronts import FILE, Front, read_front
from .pictures import draw_fronts


def find_runs(folders: list[Path]) -> list[Path]:
    """The run folders among these, and within those of multiruns.

    Raises:
        ValueError: for a folder that is neither.
    """
    found = []
    for folder in folders:
        if (folder / FILE).is_file():
            found.append(folder)
            continue
        within = sorted(path.parent for path in folder.glob(f"*/{FILE}"))
        if not within:
            raise ValueError(
                f"{folder} has no {FILE}: give run folders of recipes.benchmark.train that have been "
                "evaluated."
            )
        found += within
    return found


def configuration(run: Path) -> dict:
    """What a run was configured as; empty where that is not told."""
    file = run / ".hydra" / "config.yaml"
    try:
        config = yaml.safe_load(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError, yaml.YAMLError):
        config = None
    return config if isinstance(config, dict) else {}


def names_of(runs: list[Path], configs: list[dict]) -> list[str]:
    """What tells runs apart: algorithm and seed, or else their folders."""
    names = [
        f"{config.get('algorithm')}, seed {config.get('seed')}" if config else str(run)
        for run, config in zip(runs, configs, strict=True)
    ]
    return names if len(set(names)) == len(names) else [str(run) for run in runs]


def reference_of(
    given: list[float] | None, configs: list[dict], objectives: tuple[str, ...]
) -> list[float]:
    """The reference of the hypervolume: as given, or that of the runs.

    Raises:
        ValueError: if runs have different ones, or for another number of entries.
    """
    if given is None:
        told = [(config.get("evaluation") or {}).get("reference") for config in configs]
        if told.count(told[0]) != len(told) or told[0] is None:
            raise ValueError(f"--reference must be given: the runs have {told}.")
        given = told[0] if isinstance(told[0], list) else [told[0]]
    if len(given) == 1:
        given = given * len(objectives)
    if len(given) != len(objectives):
        raise ValueError(
            f"--reference must have {len(objectives)} entries, for {', '.join(objectives)}, or be one "
            f"number, got {given}."
        )
    return [float(value) for value in given]


def table(found: dict[str, dict[str, float]], reference: list[float]) -> str:
    """Indicators, a row a front, as Markdown."""
    columns = list(next(iter(found.values())))
    titles = ["sparsity (misleading)" if one == "sparsity" else one for one in columns]
    lines = [
        f"Reference point of the hypervolume: {', '.join(f'{value:g}' for value in reference)}.",
        "",
        f"| front | {' | '.join(titles)} |",
        f"|---|{'---|' * len(columns)}",
    ]
    lines += [
        f"| {name} | {' | '.join(f'{values[column]:.6g}' for column in columns)} |"
        for name, values in found.items()
    ]
    return "\n".join(lines)


def _same_objectives(fronts: dict[str, Front]) -> None:
    first, *others = fronts.items()
    for name, front in others:
        if front.objectives != first[1].objectives:
            raise ValueError(
                f"{first[0]} has the objectives {list(first[1].objectives)}, {name} "
                f"{list(front.objectives)}: one picture is of one environment."
            )


def main(arguments: list[str] | None = None) -> None:
    """Draw; ``--help`` lists the options."""
    parser = Parser(description=__doc__)
    parser.add_argument(
        "runs", type=existing_folder, nargs="+", help="run folders, or a multirun's"
    )
    parser.add_argument("--output", type=Path, required=True, help="picture to write")
    parser.add_argument(
        "--reference",
        type=float,
        nargs="+",
        help="of the hypervolume: a number, or one an objective; default: that of the runs",
    )
    parser.add_argument(
        "--discounted",
        action=argparse.BooleanOptionalAction,
        help="whether returns are discounted; default: as in the runs",
    )
    args = parser.parse_args(arguments)
    try:
        check_new_file(args.output)
        runs = find_runs(args.runs)
        configs = [configuration(run) for run in runs]
        names = names_of(runs, configs)
        fronts = {name: read_front(run / FILE) for name, run in zip(names, runs, strict=True)}
        _same_objectives(fronts)
        objectives = next(iter(fronts.values())).objectives
        reference = reference_of(args.reference, configs, objectives)
        discounted = args.discounted
        if discounted is None:
            discounted = any((one.get("evaluation") or {}).get("discounted") for one in configs)
        found = {
            name: front.indicators(reference, discounted=discounted)
            for name, front in fronts.items()
        }
        environments = sorted({str(one["env"]) for one in configs if "env" in one})
        draw_fronts(fronts, args.output, title=", ".join(environments), discounted=discounted)
    except (ValueError, OSError) as error:
        parser.error(str(error))
    print(table(found, reference))
    print(f"\nwritten to {args.output}")


if __name__ == "__main__":
    main()
