"""PD-MORL and MO-PPO beside CAPQL and GPI-LS of MORL-Baselines, on tasks of MO-Gymnasium.

One JSON file a training. What is there is not run again: an interrupted campaign goes on when it is started
again. Every training runs in a process of its own, one after the other.

Examples::

    python -m benchmarks.mo_gymnasium run --tasks mo-hopper-2obj-v5 --steps 20000 --seeds 0 1 2
    python -m benchmarks.mo_gymnasium table

Returns are discounted by 0.99, as in MORL-Baselines, and summed. ``gpi-ls`` makes 20 updates a step, its default;
``gpi-ls-one`` makes one, as the others do.
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib.util
import itertools
import json
import multiprocessing
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import tqdm

from recipes.arguments import Parser, count, episodes, existing_folder, seed
from recipes.outputs import check_writable
from recipes.training.run_folder import write_atomically

from .mo_gymnasium_runs import ALGORITHMS, ITERATION, PEERS, TASKS, Job, Result, measure
from .mo_gymnasium_table import read, table

FOLDER = Path("runs/benchmarks/mo_gymnasium")


def file_of(job: Job, folder: Path) -> Path:
    """Where the result of a training lies."""
    return folder / job.task / f"{job.algorithm}_{job.steps}_seed{job.seed}.json"


def left_to_do(jobs: Sequence[Job], folder: Path) -> list[Job]:
    """Those without a result.

    Raises:
        ValueError: in one line, if one that is there was evaluated otherwise.
    """
    left = []
    for job in jobs:
        file = file_of(job, folder)
        if not file.exists():
            left.append(job)
            continue
        there = read(file).job
        for name in ("preferences", "episodes"):
            if getattr(there, name) != getattr(job, name):
                raise ValueError(
                    f"--{name} {getattr(job, name)}: {file} was evaluated with {getattr(there, name)}: "
                    "give that, or another --output."
                )
    return left


def apart(job: Job) -> Result:
    """Measure in a process of its own, which inherits nothing."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        return pool.submit(measure, job).result()


def run(jobs: Sequence[Job], folder: Path, measured: Callable[[Job], Result]) -> list[str]:
    """Run trainings and write their results.

    Returns:
        A line for each that failed; the others are run nevertheless.
    """
    failed = []
    with tqdm.tqdm(jobs, unit="training") as progress:
        for job in progress:
            name = f"{job.task} {job.algorithm} seed {job.seed}"
            progress.set_postfix_str(name)
            try:
                result = measured(job)
            except (Exception, SystemExit) as error:  # a recipe exits where it refuses
                line = " ".join(f"{type(error).__name__}: {error}".split())
                failed.append(f"failed: {name}: {line}")
                continue
            file = file_of(job, folder)
            file.parent.mkdir(parents=True, exist_ok=True)
            found = {**dataclasses.asdict(result), "front": result.front_as_lists()}
            write_atomically(file, json.dumps(found) + "\n")
    return failed


def whole_iterations(text: str) -> int:
    steps = count()(text)
    if steps % ITERATION:
        raise argparse.ArgumentTypeError(
            f"must be a multiple of {ITERATION:,}, the steps between two choices of weights of GPI-LS, "
            f"got {text!r}"
        )
    return steps


def main(arguments: list[str] | None = None) -> None:
    """Run or print; ``--help`` lists the options."""
    parser = Parser(prog="mo_gymnasium", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    runs = commands.add_parser("run", help="train and evaluate what has no result yet")
    runs.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS), metavar="TASK")
    runs.add_argument(
        "--algorithms",
        nargs="+",
        choices=ALGORITHMS,
        default=[one for one in ALGORITHMS if one != "gpi-ls"],
        metavar="NAME",
        help=f"of {', '.join(ALGORITHMS)} (default: all but gpi-ls, which takes hours)",
    )
    runs.add_argument("--steps", type=whole_iterations, default=20_000, help="of the environment")
    runs.add_argument("--seeds", type=seed, nargs="+", default=[0, 1, 2], metavar="N")
    runs.add_argument(
        "--preferences", type=count(2, 10_000), default=15, help="of the evaluation, at most"
    )
    runs.add_argument("--episodes", type=episodes, default=5, help="under each of them")
    runs.add_argument("--output", type=Path, default=FOLDER, help=f"folder (default: {FOLDER})")
    tables = commands.add_parser("table", help="results as Markdown")
    tables.add_argument("folder", type=existing_folder, nargs="?", default=str(FOLDER))
    args = parser.parse_args(arguments)

    if args.command == "table":
        try:
            print(table([read(file) for file in sorted(args.folder.glob("*/*.json"))]))
        except ValueError as error:
            parser.error(str(error))
        return
    jobs = [
        Job(task, algorithm, args.steps, number, args.preferences, args.episodes)
        for task, number, algorithm in itertools.product(args.tasks, args.seeds, args.algorithms)
    ]
    missing: set[str] = set()
    if importlib.util.find_spec("morl_baselines") is None:
        missing = {job.algorithm for job in jobs} & set(PEERS)
    try:
        check_writable(args.output, args.output)
        left = left_to_do([job for job in jobs if job.algorithm not in missing], args.output)
    except ValueError as error:
        parser.error(str(error))
    failed = run(left, args.output, apart)
    print(f"{len(left) - len(failed)} trainings run, results in {args.output}")
    if missing:
        names = ", ".join(one for one in PEERS if one in missing)
        print(f"not run: {names}: MORL-Baselines is not installed, see benchmarks/README.md")
    if failed:
        print(*failed, sep="\n")
        raise SystemExit(1)


if __name__ == "__main__":
    main()
