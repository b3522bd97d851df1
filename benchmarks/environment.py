"""Environment steps per second, ours and TorchRL's own MuJoCo environment on the same task.

Everything is measured in one run and in turns, so that a busy machine slows all of it alike.

Examples::

    python -m benchmarks.environment
    python -m benchmarks.environment --sizes 1 16 --repetitions 2 --num-threads 1
    python -m benchmarks.environment --num-threads 1 --clock cpu
"""

from __future__ import annotations

import csv
import math
import os
import platform
import statistics
import time
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import torch
import tqdm

from recipes.arguments import Parser, count, positive, positive_int

from .environment_variants import OURS, PARALLEL, SERIAL, VARIANTS, Loop, navigation_env
from .output import parse_with_output

_WARM_UP_STEPS = 3

CLOCKS = {"wall": time.perf_counter, "cpu": time.process_time}
"""On a machine that does something else too, seconds on a processor are the steadier ones."""


class Case(NamedTuple):
    """One cell of the table."""

    variant: str
    num_envs: int


def steps_per_second(loop: Loop, num_envs: int, seconds: float, clock: str = "wall") -> float:
    """Environment steps per second, of one of :data:`CLOCKS`, over at least that many seconds."""
    now, steps = CLOCKS[clock], 0
    start = now()
    while (spent := now() - start) < seconds or not steps:
        loop.step()
        steps += num_envs
    return steps / spent


def measure(
    cases: list[Case], *, repetitions: int, seconds: float, num_threads: int, clock: str = "wall"
) -> dict[Case, list[float]]:
    """Steps per second of every case and repetition, taking turns within each repetition."""
    loops: dict[Case, Loop] = {}
    rates: dict[Case, list[float]] = {case: [] for case in cases}
    total = len(cases) * (1 + repetitions)
    with tqdm.tqdm(total=total, unit="measurement", desc="start") as progress:
        try:
            # Workers are forked before this process has native threads, which a fork would lose.
            for case in sorted(cases, key=lambda case: case.variant not in PARALLEL):
                loops[case] = VARIANTS[case.variant](case.num_envs, num_threads)
                for _ in range(_WARM_UP_STEPS):
                    loops[case].step()
                progress.update()
            for repetition in range(repetitions):
                progress.set_description(f"repetition {repetition + 1}/{repetitions}")
                for case in cases:
                    rate = steps_per_second(loops[case], case.num_envs, seconds, clock)
                    rates[case].append(rate)
                    progress.update()
        finally:
            for loop in loops.values():
                loop.close()
    return rates


# --- report --------------------------------------------------------------------------------------


def speed_up(rates: dict[Case, list[float]], case: Case) -> float:
    """How many times faster ours is at that size: median over repetitions of the ratio in each."""
    ours = rates[Case(OURS, case.num_envs)]
    return statistics.median(a / b for a, b in zip(ours, rates[case], strict=True))


def machine(num_threads: int) -> dict[str, str]:
    """What the numbers depend on."""
    batch_threads = navigation_env(2, num_threads).batch.nthread
    variables = [
        f"{name}={os.environ[name]}"
        for name in ("OMP_NUM_THREADS", "OMP_WAIT_POLICY")
        if name in os.environ
    ]
    packages = ("torch", "torchrl", "tensordict", "mujoco", "numpy", "numba")
    return {
        "versions": ", ".join(
            [f"python {platform.python_version()}"]
            + [f"{name} {version(name)}" for name in packages]
        ),
        "cpus": f"{len(os.sched_getaffinity(0))}",
        "load": f"{os.getloadavg()[0]:.1f}",
        "threads": ", ".join([f"physics {batch_threads}", f"torch {torch.get_num_threads()}"])
        + "".join(f", {variable}" for variable in variables),
    }


def report(
    rates: dict[Case, list[float]], skipped: dict[Case, str], info: dict[str, str], repetitions: int
) -> str:
    """The table, one line for each variant, and what it depends on."""
    sizes = sorted({case.num_envs for case in rates})
    rows = [["environments", *map(str, sizes)]]
    for variant in VARIANTS:
        row = [variant]
        for size in sizes:
            case = Case(variant, size)
            if case in rates:
                rate = f"{statistics.median(rates[case]):,.0f}"
                row.append(rate if variant == OURS else f"{rate} ({speed_up(rates, case):.2f}x)")
            else:
                row.append("not run")
        rows.append(row)
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = [
        f"Environment steps per second, median of {repetitions}; in brackets how many times faster "
        f"{OURS} is.",
        "",
    ]
    for row in rows:
        cells = [cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True)]
        lines.append("  ".join([row[0].ljust(widths[0]), *cells]))
    reasons: dict[tuple[str, str], list[str]] = {}
    for case, reason in skipped.items():
        reasons.setdefault((case.variant, reason), []).append(str(case.num_envs))
    lines.append("")
    for (variant, reason), numbers in reasons.items():
        lines.append(f"not run: {variant} with {', '.join(numbers)}: {reason}")
    lines.append(info["versions"])
    lines.append(
        f"{info['cpus']} CPUs, load {info['load']} before the start; threads: {info['threads']}; "
        f"clock: {info['clock']}"
    )
    return "\n".join(lines)


def write_csv(path: Path, rates: dict[Case, list[float]], info: dict[str, str]) -> None:
    """Every single measurement, one a line."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["variant", "num_envs", "repetition", "steps_per_second", *info])
        for case, values in rates.items():
            for repetition, value in enumerate(values):
                writer.writerow([*case, repetition, f"{value:.1f}", *info.values()])


def plan(
    sizes: list[int], *, serial_max: int, parallel_max: int, clock: str = "wall"
) -> tuple[list[Case], dict[Case, str]]:
    """Which cases to measure, and why not the others."""
    serial = (serial_max, "it steps one simulation after the other (--serial-max)")
    parallel = (parallel_max, "it takes a process for each environment (--parallel-max)")
    if clock == "cpu":
        parallel = (0, "its processes have clocks of their own (--clock)")
    limits = {
        "MujocoEnv, one mj_multiRay": (1, "it holds one simulation"),
        **dict.fromkeys(SERIAL, serial),
        **dict.fromkeys(PARALLEL, parallel),
    }
    cases, skipped = [], {}
    for size in sorted(set(sizes)):
        for variant in VARIANTS:
            limit, reason = limits.get(variant, (math.inf, ""))
            if size <= limit:
                cases.append(Case(variant, size))
            else:
                skipped[Case(variant, size)] = reason
    return cases, skipped


def main(arguments: list[str] | None = None) -> None:
    """Measure; ``--help`` lists the options."""
    parser = Parser(prog="environment", description=__doc__)
    parser.add_argument("--sizes", type=int, nargs="+", default=[1, 16, 64, 256, 1024], metavar="N")
    parser.add_argument("--repetitions", type=int, default=5, help="rounds over all cases")
    parser.add_argument("--seconds", type=positive, default=1.0, help="of each measurement")
    parser.add_argument("--serial-max", type=count(0), default=64, help="largest SerialEnv")
    parser.add_argument("--parallel-max", type=count(0), default=16, help="largest ParallelEnv")
    parser.add_argument(
        "--num-threads",
        type=count(0),
        default=0,
        help="of NavigationEnv's physics (default: every CPU)",
    )
    parser.add_argument(
        "--clock", choices=CLOCKS, default="wall", help="cpu: seconds on a processor"
    )
    parser.add_argument(
        "--torch-threads", type=positive_int, default=1, help="of PyTorch, in all variants"
    )
    args = parse_with_output(parser, arguments, "environment.csv")
    if min(args.sizes) < 1 or args.repetitions < 1:
        parser.error("--sizes and --repetitions must be at least 1.")

    torch.set_num_threads(args.torch_threads)
    torch.manual_seed(0)
    load = f"{os.getloadavg()[0]:.1f}"
    cases, skipped = plan(
        args.sizes,
        serial_max=args.serial_max,
        parallel_max=args.parallel_max,
        clock=args.clock,
    )
    rates = measure(
        cases,
        repetitions=args.repetitions,
        seconds=args.seconds,
        num_threads=args.num_threads,
        clock=args.clock,
    )
    info = {**machine(args.num_threads), "load": load, "clock": args.clock}
    print(report(rates, skipped, info, args.repetitions))
    write_csv(args.output, rates, info)
    print(f"every measurement: {args.output}")


if __name__ == "__main__":
    main()
