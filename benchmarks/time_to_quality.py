"""Success of the policy against the wall time of its training: this project beside MORL-Baselines.

One process trains one system with one seed and appends a line to a CSV file at every evaluation:
the same scenes, preferences and function as in ``recipes.pd_morl``. The clock stands still during an
evaluation, and runs from the construction of the agent, compilation included. Beside the wall time stands the
time on a processor: with one thread it hardly depends on what else the machine does.

Examples::

    python -m benchmarks.time_to_quality train ours --seed 0
    python -m benchmarks.time_to_quality train capql --seed 0 --minutes 60
    python -m benchmarks.time_to_quality report runs/benchmarks/quality/*.csv
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import tempfile
import time
from importlib.metadata import version
from pathlib import Path
from unittest import mock

import matplotlib
import numpy as np
import torch
import tqdm
from matplotlib import pyplot
from torchrl.collectors import Collector

from recipes.arguments import Parser
from recipes.training import corner_evaluation
from recipes.training.corners import CornerResult, evaluate_corners
from recipes.training.task import make_task

from . import quality_peers
from .workload import PD_MORL, config, run_recipe

matplotlib.use("Agg")

OURS = "ours"
FOLDER = Path("runs/benchmarks/quality")
CAPQL = ("capql", "capql-our-weights")
PEERS = (*CAPQL, "gpi-ls")
PEERS_MINUTES = 60


class Enough(BaseException):
    """Ends a training of ours at a time. Not an ``Exception``: hydra reports those as errors."""


class Log:
    """A CSV file of evaluations, and a clock that they stop."""

    def __init__(self, path: Path, system: str, seed: int, label: str | None = None) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists():
            raise FileExistsError(f"{path} exists and is not overwritten: choose another --output.")
        self.path, self.system, self.seed = path, system, seed
        self.label = label or system
        self.start()

    def start(self) -> None:
        """Set the clock to zero."""
        self._paused = self._now() * 0
        self._start = self._now()

    @property
    def seconds(self) -> tuple[float, float]:
        """Of training: wall time, and time on a processor."""
        wall, cpu = self._now() - self._start - self._paused
        return wall, cpu

    @staticmethod
    def _now() -> np.ndarray:
        return np.array((time.perf_counter(), time.process_time()))

    def evaluate(self, steps: int, function, *args) -> CornerResult:
        """Call the recipe's evaluation and write its result down."""
        (seconds, cpu), start = self.seconds, self._now()
        result = function(*args)
        row = {
            "system": self.label,
            "seed": self.seed,
            "seconds": f"{seconds:.1f}",
            "cpu_seconds": f"{cpu:.1f}",
            "steps": steps,
            "success": f"{result.success:.2f}",
            "score": f"{result.score:.3f}",
        }
        for name, success in zip(result.names, result.columns["success"], strict=True):
            row[f"success {name}"] = f"{success:.2f}"
        with self.path.open("a", newline="") as file:
            writer = csv.DictWriter(file, row)
            if file.tell() == 0:
                writer.writeheader()
            writer.writerow(row)
        tqdm.tqdm.write(
            f"{seconds / 60:6.1f} min  {steps:>9,} steps  success {result.success:.1f} %"
        )
        self._paused += self._now() - start
        return result


def train_ours(log: Log, args: argparse.Namespace) -> None:
    """The recipe as it is, its evaluation under the log."""
    steps = 0
    plain_rollout = Collector.rollout

    def evaluate(*given):
        result = log.evaluate(steps, evaluate_corners, *given)
        if args.minutes is not None and log.seconds[args.clock == "cpu"] >= 60 * args.minutes:
            raise Enough
        return result

    def rollout(collector: Collector):
        nonlocal steps
        data = plain_rollout(collector)
        steps += data.numel()
        return data

    with tempfile.TemporaryDirectory() as folder:
        overrides = [f"seed={log.seed}", f"hydra.run.dir={folder}/run", *args.pd_morl]
        with (
            mock.patch.object(corner_evaluation, "evaluate_corners", evaluate),
            mock.patch.object(Collector, "rollout", rollout),
            contextlib.suppress(Enough),
        ):
            log.start()
            run_recipe(PD_MORL, *overrides)


def train_peer(log: Log, args: argparse.Namespace) -> None:
    """Until the time is up, evaluated every so many minutes of training."""
    cfg = config(*args.pd_morl)
    if cfg.demonstrations.dataset is not None:
        raise ValueError(
            "demonstrations.dataset is for this project's recipe: peers replay no demonstrations."
        )
    torch.set_num_threads(cfg.compute.torch_threads)
    scale = cfg.replay_buffer.reward_scale if args.reward_scale is None else args.reward_scale
    task = make_task(cfg, run_dir=Path())
    model, demo_card = task.reward_model, task.demo_card
    budget = PEERS_MINUTES if args.minutes is None else args.minutes
    due = args.every

    def evaluate(steps: int) -> None:
        minutes = log.seconds[args.clock == "cpu"] / 60
        result = log.evaluate(steps, evaluate_corners, cfg, task, peer.actor.eval())
        if args.save is not None:
            card = {
                "system": f"MORL-Baselines {version('morl-baselines')} {log.system}",
                "config": {
                    "seed": log.seed,
                    "gamma": args.gamma,
                    "reward_scale": scale,
                    "env": quality_peers.ENV,
                },
                "steps": steps,
                "minutes": round(minutes, 1),
                "evaluation": {"preferences": result.names, **result.columns},
                "score": result.score,
                **({"demonstrator": demo_card["demonstrator"]} if demo_card else {}),
            }
            peer.save(args.save / f"{steps:09d}", card)

    def after_step(steps: int) -> None:
        nonlocal due
        minutes = log.seconds[args.clock == "cpu"] / 60
        finished = minutes >= budget
        if finished or minutes >= due:
            due += args.every
            evaluate(steps)
        if finished:
            raise quality_peers.Finished

    env = quality_peers.make_env(log.seed, scale, after_step, model)
    log.start()
    peer = quality_peers.Peer(log.system, env, seed=log.seed, gamma=args.gamma)
    # GPI-LS itself evaluates, to choose its next weights: that is part of its training.
    own_eval_env = quality_peers.make_env(log.seed + 1000, scale, reward_model=model)
    peer.train(args.max_steps, own_eval_env)


# --- report --------------------------------------------------------------------------------------


def read(paths: list[Path]) -> Runs:
    """Evaluations of each system and seed, in their order."""
    runs: Runs = {}
    for path in paths:
        with path.open() as file:
            for row in csv.DictReader(file):
                runs.setdefault((row["system"], row["seed"]), []).append(row)
    return runs


Runs = dict[tuple[str, str], list[dict[str, str]]]
"""Evaluations by system and seed."""

CLOCKS = {"wall": "seconds", "cpu": "cpu_seconds"}


def minutes_to(rows: list[dict[str, str]], success: float, clock: str = "wall") -> float | None:
    """Training time of the first evaluation with at least that success, in percent."""
    for row in rows:
        if float(row["success"]) >= success:
            return float(row[CLOCKS[clock]]) / 60
    return None


def table(runs: Runs, success: float, clock: str = "wall") -> str:
    """As Markdown."""
    lines = [
        f"| system | seed | {clock} minutes to {success:g} % | best | last | minutes | steps |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for (system, seed), rows in sorted(runs.items()):
        reached = minutes_to(rows, success, clock)
        best = max(float(row["success"]) for row in rows)
        last = rows[-1]
        lines.append(
            f"| {system} | {seed} | {'not reached' if reached is None else f'{reached:.1f}'} "
            f"| {best:.1f} % | {float(last['success']):.1f} % "
            f"| {float(last[CLOCKS[clock]]) / 60:.1f} | {int(last['steps']):,} |"
        )
    return "\n".join(lines)


def plot(runs: Runs, path: Path, clock: str = "wall") -> None:
    """Success against minutes, one line a run, one colour a system."""
    figure, axes = pyplot.subplots(figsize=(7, 4), layout="constrained")
    systems = sorted({system for system, _ in runs})
    for (system, seed), rows in sorted(runs.items()):
        axes.plot(
            [float(row[CLOCKS[clock]]) / 60 for row in rows],
            [float(row["success"]) for row in rows],
            color=f"C{systems.index(system)}",
            label=system if seed == min(s for name, s in runs if name == system) else None,
        )
    axes.set(
        xlabel=f"minutes of training ({clock})",
        ylabel="success over the preferences, %",
        ylim=(0, 101),
    )
    axes.legend()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)
    pyplot.close(figure)


def main(arguments: list[str] | None = None) -> None:
    """Train or report; ``--help`` lists the options."""
    parser = Parser(prog="time_to_quality", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    train = commands.add_parser("train", help="one system, one seed")
    train.add_argument("system", choices=[OURS, *PEERS])
    train.add_argument("--seed", type=int, default=0)
    train.add_argument("--output", type=Path, help=f"(default: {FOLDER}/LABEL_SEED.csv)")
    train.add_argument("--label", help="name in the report (default: the system)")
    train.add_argument(
        "--minutes",
        type=float,
        help="of training, to the evaluation after them "
        f"(default: ours to its last step, peers {PEERS_MINUTES})",
    )
    peers = train.add_argument_group("of the peers")
    peers.add_argument("--every", type=float, default=3, help="minutes between evaluations")
    peers.add_argument("--gamma", type=float, default=0.99, help="discount (theirs: 0.99)")
    peers.add_argument("--reward-scale", type=float, help="(default: the recipe's)")
    peers.add_argument(
        "--save", type=Path, help="folder for the policy of every evaluation, of CAPQL alone"
    )
    peers.add_argument("--max-steps", type=int, default=10_000_000, help=argparse.SUPPRESS)
    train.add_argument(
        "--pd-morl", nargs="*", default=[], metavar="FIELD=VALUE", help="overrides of its recipe"
    )
    report = commands.add_parser("report", help="times to a success, from CSV files")
    report.add_argument("paths", type=Path, nargs="+")
    report.add_argument("--success", type=float, default=95, help="percent")
    report.add_argument("--plot", type=Path, help="a picture of the curves")
    for command in (train, report):
        command.add_argument(
            "--clock",
            choices=CLOCKS,
            default="wall",
            help="cpu: time on a processor, for a machine that does other work too",
        )
    args = parser.parse_args(arguments)

    if args.command == "report":
        runs = read(args.paths)
        print(table(runs, args.success, args.clock))
        if args.plot:
            plot(runs, args.plot, args.clock)
        return
    if args.save is not None and args.system not in CAPQL:
        parser.error(f"--save is for {' and '.join(CAPQL)}, not {args.system}.")
    if args.save is not None and args.save.exists():
        parser.error(f"{args.save} exists and is not overwritten: choose another --save.")
    output = args.output or FOLDER / f"{args.label or args.system}_{args.seed}.csv"
    log = Log(output, args.system, args.seed, args.label)
    if args.system == OURS:
        train_ours(log, args)
    else:
        train_peer(log, args)
    print(table(read([log.path]), 95, args.clock))


if __name__ == "__main__":
    main()
