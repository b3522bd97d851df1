"""Learner updates per second: this project's, its peers', and what the machine could do at best.

All systems do 10 updates each, in turns, over and over: load that comes and goes slows all of them
down alike, and ratios are taken within a turn.

Examples::

    python -m benchmarks.learner
    python -m benchmarks.learner --threads 1 --rounds 5 --systems ours "bare loop" CAPQL
"""

from __future__ import annotations

import csv
import importlib.util
import logging
import os
import platform
import statistics
import time
from collections import Counter
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import torch
import torchrl
import tqdm

from recipes.arguments import Parser

from .floor import MatrixRate, flops
from .learner_base import Learner
from .learner_systems import OURS, OURS_EQUAL, SYSTEMS, System
from .output import parse_with_output
from .workload import UPDATES, transitions

Rates = dict[tuple[str, int], list[float]]
"""Of every system and number of threads: updates per second, or operations of matrix products."""

Spent = dict[tuple[str, int], Counter[str]]
"""Seconds in each stage of the updates."""

Clock = Callable[[], float]
CLOCKS: dict[str, Clock] = {"wall": time.perf_counter, "cpu": time.process_time}

PRECISIONS = {"float32": torch.float32, "bfloat16": torch.bfloat16}


def available(names: list[str]) -> tuple[list[str], dict[str, str]]:
    """The systems that can be run, and why not the others."""
    missing = {
        name: f"{module} is not installed, see benchmarks/README.md"
        for name in names
        for module in SYSTEMS[name].requires
        if importlib.util.find_spec(module) is None
    }
    return [name for name in names if name not in missing], missing


def count_flops(system: System, data) -> float:
    """Operations per update, in the mean over a cycle of the policy delay."""
    torch.set_num_threads(1)
    learner = system.make(data, False)

    def cycle() -> None:
        for _ in range(UPDATES):
            learner.update()

    return flops(cycle) / UPDATES


# Every system compiles anew for every number of threads.
@torch._dynamo.config.patch(recompile_limit=64)
def measure(
    names: list[str],
    threads: list[int],
    *,
    rounds: int,
    size: int,
    compiled: bool,
    clock: Clock = time.perf_counter,
) -> tuple[Rates, Spent, dict[str, float]]:
    """Rates of every system, and of the matrix products beside them; operations per update."""
    data = transitions(size)
    operations = {name: count_flops(SYSTEMS[name], data[:1000]) for name in names}
    products = {name: MatrixRate(precision) for name, precision in PRECISIONS.items()}
    learners: dict[str, Learner] = {}
    rates: Rates = {}
    spent: Spent = {}
    total = len(names) * len(threads) * (1 + rounds)
    with tqdm.tqdm(total=total, unit="turn", desc="start", mininterval=1) as progress:
        for name in names:
            learners[name] = SYSTEMS[name].make(data, compiled and SYSTEMS[name].compiled)
            for number in threads:
                torch.set_num_threads(number)
                turn(learners[name], clock)
                progress.update()
        for repetition in range(rounds):
            progress.set_description(f"round {repetition + 1}/{rounds}")
            this: dict[tuple[str, int], float] = {}
            try:
                for number in threads:
                    torch.set_num_threads(number)
                    for precision, product in products.items():
                        this[precision, number] = product(clock)
                    for name in names:
                        stages = spent.setdefault((name, number), Counter())
                        this[name, number] = turn(learners[name], clock, stages)
                        progress.update()
            except KeyboardInterrupt:
                # What is complete is worth a table.
                break
            for case, rate in this.items():
                rates.setdefault(case, []).append(rate)
    return rates, spent, operations


def turn(learner: Learner, clock: Clock, stages: Counter[str] | None = None) -> float:
    """Updates per second over one turn; adds the seconds of every stage up."""
    stages = Counter() if stages is None else stages
    now = start = clock()
    for _ in range(UPDATES):
        for name, run in learner.stages():
            run()
            before, now = now, clock()
            stages[name] += now - before
    return UPDATES / (now - start)


# --- report --------------------------------------------------------------------------------------


def ratio(rates: Rates, first: tuple[str, int], second: tuple[str, int]) -> float:
    """How many times faster the first is: median over rounds of the ratio in each."""
    return statistics.median(a / b for a, b in zip(rates[first], rates[second], strict=True))


def share_of_floor(rates: Rates, name: str, threads: int, operations: float) -> float:
    """Share of an update that the matrix products would take at this machine's rate."""
    products = rates[SYSTEMS[name].precision, threads]
    return statistics.median(
        rate * operations / product
        for rate, product in zip(rates[name, threads], products, strict=True)
    )


def table(rates: Rates, operations: dict[str, float], threads: int) -> str:
    """As Markdown."""
    names = [name for name in operations if (name, threads) in rates]
    references = [name for name in (OURS, OURS_EQUAL) if name in names]
    header = ["system", "updates/s", *(f"`{name}` is" for name in references)]
    rows = [[*header, "GFLOP/update", "of the floor"]]
    for name in names:
        row = [name, f"{statistics.median(rates[name, threads]):.1f}"]
        row += [f"{ratio(rates, (other, threads), (name, threads)):.2f}x" for other in references]
        share = share_of_floor(rates, name, threads, operations[name])
        rows.append([*row, f"{operations[name] / 1e9:.2f}", f"{100 * share:.0f} %"])
    rows.insert(1, ["---"] * len(rows[0]))
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


def stage_table(spent: Spent, rates: Rates, threads: int) -> str:
    """Milliseconds of an update by stage, in the mean over its cycle, as Markdown."""
    systems = [name for name, number in spent if number == threads]
    stages = list(dict.fromkeys(stage for name in systems for stage in spent[name, threads]))
    rows = [["system", *stages], ["---"] * (1 + len(stages))]
    for name in systems:
        seconds = spent[name, threads]
        # Of all rounds, while the rate is a median: scaled, so that the row adds up to an update.
        scale = 1000 / statistics.median(rates[name, threads]) / seconds.total()
        cells = (f"{scale * seconds[stage]:.2f}" if stage in seconds else "" for stage in stages)
        rows.append([name, *cells])
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


def report(
    rates: Rates, spent: Spent, operations: dict[str, float], missing: dict[str, str]
) -> str:
    lines = []
    for threads in sorted({number for _, number in rates}):
        lines += [f"{threads} thread{'s' * (threads > 1)}:", "", table(rates, operations, threads)]
        products = ", ".join(
            f"{statistics.median(rates[precision, threads]) / 1e9:.0f} in {precision}"
            for precision in PRECISIONS
        )
        lines += ["", f"matrix products, GFLOP/s: {products}", ""]
        lines += ["milliseconds of an update:", "", stage_table(spent, rates, threads), ""]
    lines += [f"not run: {name}: {reason}" for name, reason in missing.items()]
    return "\n".join([*lines, machine()])


def machine() -> str:
    """What the numbers depend on."""
    versions = []
    for name in ("torch", "torchrl", "tensordict", "numpy", "morl-baselines"):
        try:
            versions.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            continue
    variables = [
        f"{name}={os.environ[name]}"
        for name in ("OMP_NUM_THREADS", "OMP_WAIT_POLICY")
        if name in os.environ
    ]
    cpus = f"{len(os.sched_getaffinity(0))} CPUs ({cpu()}), load {os.getloadavg()[0]:.1f}"
    return ", ".join([f"python {platform.python_version()}", *versions, cpus, *variables])


def cpu() -> str:
    path = Path("/proc/cpuinfo")
    lines = path.read_text().splitlines() if path.exists() else []
    names = [line.split(": ")[1] for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def write_csv(path: Path, rates: Rates) -> None:
    """Every single measurement, one a line."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["system", "threads", "round", "per_second"])
        for (name, threads), values in rates.items():
            kind = f"matrix products, {name}" if name in PRECISIONS else name
            for index, value in enumerate(values):
                writer.writerow([kind, threads, index, f"{value:.6g}"])


def main(arguments: list[str] | None = None) -> None:
    """Measure; ``--help`` lists the options."""
    parser = Parser(prog="learner", description=__doc__)
    parser.add_argument("--systems", nargs="+", default=list(SYSTEMS), metavar="NAME")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2], metavar="N")
    parser.add_argument("--rounds", type=int, default=30, help="turns of each system")
    parser.add_argument(
        "--clock",
        choices=CLOCKS,
        default="wall",
        help="cpu: seconds of this process, for one thread on a machine that does other work too",
    )
    parser.add_argument("--size", type=int, default=100_000, help="of the replay buffers")
    parser.add_argument("--no-compile", action="store_true", help="everything eager")
    args = parse_with_output(parser, arguments, "learner.csv")
    if unknown := set(args.systems) - set(SYSTEMS):
        parser.error(f"unknown systems {sorted(unknown)}; there are {list(SYSTEMS)}.")
    if min(*args.threads, args.rounds) < 1 or args.size < 1000:
        parser.error("--threads and --rounds must be at least 1, --size at least 1000.")

    if args.clock == "cpu" and args.threads != [1]:
        parser.error("--clock cpu adds the seconds of all threads up: take --threads 1.")

    torchrl.logger.setLevel(logging.WARNING)
    torch.manual_seed(0)
    names, missing = available(args.systems)
    rates, spent, operations = measure(
        names,
        args.threads,
        rounds=args.rounds,
        size=args.size,
        compiled=not args.no_compile,
        clock=CLOCKS[args.clock],
    )
    if not rates:
        raise SystemExit("interrupted before the first round was complete.")
    print(report(rates, spent, operations, missing), f"clock: {args.clock}", sep="\n")
    write_csv(args.output, rates)
    print(f"every measurement: {args.output}")


if __name__ == "__main__":
    main()
