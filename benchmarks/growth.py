"""Cost of growth: time and memory against environments, objectives, replay and preferences.

Every size is measured in a process of its own, one after the other, on one torch thread and one
thread of physics.

Examples::

    python -m benchmarks.growth
    python -m benchmarks.growth --clock cpu --grows preferences --sizes 1 11 33
"""

from __future__ import annotations

import csv
import math
import multiprocessing
import os
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import NamedTuple

import tqdm

from recipes.arguments import Parser, number, positive_int

from .growth_cases import CASES, CLOCKS, Cost, Options, measure
from .learner import machine
from .output import parse_with_output

SIZES = {
    "environments": (1, 4, 16, 64, 256, 1024),
    "objectives": (2, 4, 8, 16),
    "replay": (10_000, 100_000, 1_000_000),
    "preferences": (1, 11, 33, 101, 1001),
}

MEGABYTE = 1e6

Costs = dict[str, dict[int, Cost]]


class Quantity(NamedTuple):
    """One row of the table for each thing that grows."""

    name: str
    cost: Callable[[Cost], float]
    """What the exponent is of."""
    show: Callable[[int, Cost], str]
    floor: float
    """Below this a cost is noise."""


def _milliseconds(size: int, cost: Cost) -> str:
    return f"{1000 * cost.seconds:.2f}"


def _seconds(cost: Cost) -> float:
    return cost.seconds


_MEMORY = Quantity(
    "peak memory, MB",
    lambda cost: cost.bytes,
    lambda size, cost: f"{cost.bytes / MEGABYTE:,.0f}",
    # What the allocator keeps for later differs from run to run.
    floor=8 * MEGABYTE,
)

QUANTITIES = {
    "environments": Quantity(
        "steps/s", _seconds, lambda size, cost: f"{size / cost.seconds:,.0f}", 0
    ),
    "objectives": Quantity("losses and relabelling, ms", _seconds, _milliseconds, 0),
    "replay": Quantity("sample, relabel, ms", _seconds, _milliseconds, 0),
    "preferences": Quantity("sweep, s", _seconds, lambda size, cost: f"{cost.seconds:.2f}", 0),
}


def run(sizes: dict[str, tuple[int, ...]], options: Options) -> Costs:
    """Measure every size in a fresh process that has imported everything, but done nothing."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["benchmarks.growth_cases"])
    costs: Costs = {}
    total = sum(map(len, sizes.values()))
    with tqdm.tqdm(total=total, unit="size", mininterval=1) as progress:
        for case, values in sizes.items():
            for size in values:
                progress.set_description(f"{case} {size:,}")
                with ProcessPoolExecutor(1, mp_context=context) as executor:
                    cost = executor.submit(measure, case, size, options).result()
                costs.setdefault(case, {})[size] = cost
                progress.update()
    return costs


# --- report --------------------------------------------------------------------------------------


def exponent(costs: dict[int, float]) -> float:
    """Slope of log(cost) over log(size) between the two largest sizes.

    At the smaller ones the fixed part of the cost hides its growth.
    """
    if len(costs) < 2:
        return math.nan
    small, large = sorted(costs)[-2:]
    return math.log(costs[large] / costs[small]) / math.log(large / small)


def verdict(slope: float) -> str:
    """In a word."""
    if math.isnan(slope):
        return "one size"
    for limit, word in ((0.25, "flat"), (0.75, "below linear"), (1.25, "linear")):
        if slope < limit:
            return word
    return "worse than linear"


def full_at(costs: dict[int, Cost], memory: float) -> str:
    """The size that needs all of the memory, along the line through the two largest sizes."""
    (small, low), (large, high) = sorted(costs.items())[-2:]
    slope = (high.bytes - low.bytes) / (large - small)
    size = large + (memory - high.bytes) / slope
    digits = 10 ** (math.floor(math.log10(size)) - 1)
    return f"{round(size / digits) * digits:,.0f}"


def table(costs: Costs, memory: float) -> str:
    """As Markdown."""
    header = ["grows", "sizes", "cost", "at each size", "exponent", "verdict", "memory is full at"]
    rows = [header, ["---"] * len(header)]
    for case, by_size in costs.items():
        for quantity in (QUANTITIES[case], _MEMORY):
            values = {size: max(quantity.cost(c), quantity.floor) for size, c in by_size.items()}
            slope = exponent(values)
            grows = quantity is _MEMORY and slope >= 0.25
            rows.append(
                [
                    case,
                    " / ".join(f"{size:,}" for size in by_size),
                    quantity.name,
                    " / ".join(quantity.show(*item) for item in by_size.items()),
                    f"{slope:.2f}",
                    verdict(slope),
                    full_at(by_size, memory) if grows else "",
                ]
            )
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


def write_csv(path: Path, costs: Costs) -> None:
    """Every single measurement, one a line."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["grows", "size", "seconds", "bytes"])
        for case, by_size in costs.items():
            for size, cost in by_size.items():
                writer.writerow([case, size, f"{cost.seconds:.6g}", int(cost.bytes)])


def main(arguments: list[str] | None = None) -> None:
    """Measure; ``--help`` lists the options."""
    parser = Parser(prog="growth", description=__doc__)
    parser.add_argument("--grows", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--sizes", type=int, nargs="+", help="instead of those of the table")
    parser.add_argument(
        "--clock",
        choices=CLOCKS,
        default="wall",
        help="cpu: seconds of the process, on a machine that does other work too",
    )
    defaults = Options()
    parser.add_argument(
        "--seconds", type=number(0), default=defaults.seconds, help="of a measurement"
    )
    parser.add_argument("--scenes", type=positive_int, default=defaults.scenes, help="of the sweep")
    parser.add_argument(
        "--steps", type=positive_int, default=defaults.steps, help="of the sweep's episodes"
    )
    args = parse_with_output(parser, arguments, "growth.csv")
    if args.sizes and (len(args.grows) > 1 or min(args.sizes) < 1):
        parser.error("--sizes are positive, and those of one --grows.")

    options = Options(args.clock, args.seconds, args.scenes, args.steps)
    sizes = {case: tuple(args.sizes or SIZES[case]) for case in args.grows}
    costs = run(sizes, options)
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    print(table(costs, memory))
    print(f"\nclock: {args.clock}; sweep: {args.scenes} scenes, at most {args.steps} steps")
    print(f"{machine()}, {memory / 1e9:.0f} GB")
    write_csv(args.output, costs)
    print(f"every measurement: {args.output}")


if __name__ == "__main__":
    main()
