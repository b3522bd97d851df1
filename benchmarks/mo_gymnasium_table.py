"""Results of :mod:`benchmarks.mo_gymnasium` as tables: indicators, and what the corners return."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from recipes.benchmark.fronts import Front
from torchrl_morl.evaluation import bootstrap_interval

from .mo_gymnasium_runs import ALGORITHMS, REFERENCE, TASKS, Job, Result

Row = tuple[str, int, list[Result]]
"""An algorithm, its steps, and the results of its seeds."""


def read(file: Path) -> Result:
    """A result.

    Raises:
        ValueError: in one line, if it is none.
    """
    try:
        found = json.loads(file.read_text(encoding="utf-8"))
        front = {name: np.array(found["front"][name], float) for name in found["front"]}
        front["objectives"] = TASKS[found["job"]["task"]]
        result = Result(**{**found, "job": Job(**found["job"]), "front": Front(**front)})
        result.front.indicators([REFERENCE] * len(result.front.objectives))
        ALGORITHMS.index(result.job.algorithm)
    except (ValueError, KeyError, TypeError, IndexError, OSError) as error:
        raise ValueError(f"{file} is no result of a run: {error!r}") from error
    return result


def table(results: Sequence[Result]) -> str:
    """A pair of tables a task, with a row an algorithm and a number of steps, as Markdown.

    Raises:
        ValueError: if there is nothing, or if results of one task were evaluated differently.
    """
    if not results:
        raise ValueError("there is no result: run some first.")
    blocks = []
    for task in TASKS:
        of_task = [one for one in results if one.job.task == task]
        ways = sorted({(one.job.preferences, one.job.episodes) for one in of_task})
        if len(ways) > 1:
            raise ValueError(
                f"{task} was evaluated in different ways, (preferences, episodes) {ways}: give each a "
                "folder of its own."
            )
        kinds = sorted({(ALGORITHMS.index(one.job.algorithm), one.job.steps) for one in of_task})
        rows = []
        for place, steps in kinds:
            kind = (ALGORITHMS[place], steps)
            same = [one for one in of_task if (one.job.algorithm, one.job.steps) == kind]
            rows.append((*kind, same))
        if rows:
            blocks += [indicators(task, rows), corners(task, rows)]
    return "\n\n".join(blocks)


def indicators(task: str, rows: Sequence[Row]) -> str:
    """Hypervolume and utilities, mean over seeds [95 %], and what they cost."""
    titles = [
        task,
        "steps",
        "seeds",
        "hypervolume",
        "expected utility",
        "as commanded",
        "expected utility, sums",
        "processor s",
        "further steps",
    ]
    lines = [_row(titles), "|" + len(titles) * "---|"]
    for algorithm, steps, results in rows:
        reference = [REFERENCE] * len(TASKS[task])
        discounted = [one.front.indicators(reference, discounted=True) for one in results]
        sums = [one.front.indicators(reference) for one in results]
        lines.append(
            _row(
                [
                    algorithm,
                    f"{steps:,}",
                    str(len(results)),
                    interval([one["hypervolume"] for one in discounted]),
                    interval([one["expected_utility"] for one in discounted]),
                    interval([one["commanded_utility"] for one in discounted]),
                    interval([one["expected_utility"] for one in sums]),
                    f"{np.mean([one.cpu_seconds for one in results]):,.0f}",
                    f"{np.mean([one.further_steps for one in results]):,.0f}",
                ]
            )
        )
    return "\n".join(lines)


def corners(task: str, rows: Sequence[Row]) -> str:
    """What is returned where all weight is on one objective, and whether returns follow weights.

    The rank correlation is that of the objective's weight and discounted return over the lattice.
    """
    names = TASKS[task]
    titles = [
        task,
        "steps",
        "all weight on",
        *(f"{name}, discounted" for name in names),
        *(f"{name}, sum" for name in names),
        "rank correlation",
    ]
    lines = [_row(titles), "|" + len(titles) * "---|"]
    reference = [REFERENCE] * len(names)
    for algorithm, steps, results in rows:
        fronts = [one.front for one in results]
        for index, name in enumerate(names):
            rho = [
                one.indicators(reference, discounted=True)[f"steerability/{name}"] for one in fronts
            ]
            returned = [
                np.concatenate([one.discounted[place], one.returns[place]])
                for one in fronts
                for place in [int(one.preferences[:, index].argmax())]
            ]
            cells = [f"{value:,.0f}" for value in np.mean(returned, axis=0)]
            lines.append(_row([algorithm, f"{steps:,}", name, *cells, f"{np.mean(rho):.2f}"]))
    return "\n".join(lines)


def interval(values: Sequence[float]) -> str:
    """Mean over seeds with its bootstrap interval; of one seed the value alone.

    Examples:
        >>> interval([1.0]), interval([2000.0, 2000.0])
        ('1.0', '2,000 [2,000, 2,000]')
    """
    found = bootstrap_interval(values)
    form = ",.0f" if abs(found.estimate) >= 1000 else ".1f"
    text = f"{found.estimate:{form}}"
    return text if found.n < 2 else f"{text} [{found.low:{form}}, {found.high:{form}}]"


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"
