"""Table I of the paper from the evaluations in a folder, beside the paper's numbers.

Example::

    python -m recipes.results.table runs/results
    python -m recipes.results.table runs/results --condition moving_human --reference OUR
"""

from __future__ import annotations

import math
from pathlib import Path

from torchrl_morl.evaluation import Interval, significance_mark

from ..arguments import Parser
from ..objectives import OBJECTIVES
from . import paper
from .comparison import (
    QUANTITIES,
    exposure_steering,
    indicators,
    ratio_to_bound,
    steering,
)
from .files import Evaluation, read_evaluations


def markdown_row(cells: list[str]) -> str:
    """Cells as a line of a Markdown table."""
    return f"| {' | '.join(cells)} |"


def markdown(header: list[str], rows: list[list[str]]) -> str:
    """A Markdown table."""
    lines = [markdown_row(header), markdown_row(["---"] * len(header)), *map(markdown_row, rows)]
    return "\n".join(lines)


def shown(interval: Interval | None, digits: int) -> str:
    """An estimate with its interval and n, or a dash."""
    if interval is None or not interval.n:
        return "-"
    low, high = (f"{value:.{digits}f}" for value in (interval.low, interval.high))
    return f"{interval.estimate:.{digits}f} [{low}, {high}] ({interval.n:,})"


def main_table(evaluations: dict[str, Evaluation]) -> str:
    """The columns of Table I, one row a system; under it the paper's where it has one."""
    header = ["system", "seeds", *(quantity.title for quantity in QUANTITIES.values())]
    rows = []
    for name, evaluation in evaluations.items():
        cells = [shown(one.interval(evaluation), one.digits) for one in QUANTITIES.values()]
        rows.append([f"**{name}**", str(len(evaluation.seeds)), *cells])
        if name in paper.TABLE and evaluation.condition == paper.CONDITION:
            printed = dict(zip(paper.COLUMNS, paper.TABLE[name], strict=True))
            values = (printed.get(column, math.nan) for column in QUANTITIES)
            cells = ["-" if math.isnan(value) else f"{value:g}" for value in values]
            rows.append([f"{name} in the paper", "", *cells])
    return markdown(header, rows)


def bounds_table(evaluations: dict[str, Evaluation]) -> str:
    """Time at efficiency = 1 against its bounds, what steers what, and the sweep's indicators."""
    weighed = {name for evaluation in evaluations.values() for name in evaluation.objectives}
    steered = [objective for objective in OBJECTIVES.values() if objective.name in weighed]
    header = ["system", "time / straight line", "time / shortest way"]
    header += [f"rho of {one.name} (ideal {one.sign:+d})" for one in steered]
    header += ["rho of distance and exposure (ideal -1)"] * ("distance" in weighed)
    header += ["hypervolume", "expected utility", "the same, best choice"]
    rows = []
    for name, evaluation in evaluations.items():
        rho, sweep = steering(evaluation), indicators(evaluation)
        exposure = [exposure_steering(evaluation)] * ("distance" in weighed)
        numbers = [ratio_to_bound(evaluation, f"{kind}_time") for kind in ("straight", "shortest")]
        cells = [_number(value, 3) for value in numbers]
        cells += [_number(rho.get(one.name), 2, sign=True) for one in steered]
        cells += [_number(value, 2, sign=True) for value in exposure]
        keys = ("hypervolume", "expected utility", "expected utility, best")
        rows.append([name, *cells, *(_number(sweep.get(key), 3) for key in keys)])
    return markdown(header, rows)


def seeds_table(evaluations: dict[str, Evaluation]) -> str:
    """Every training seed on its own, and the interquartile mean over all of them."""
    header = ["system", "training seed", *(one.title for one in QUANTITIES.values())]
    rows = []
    for name, evaluation in evaluations.items():
        columns = [(one.per_seed(evaluation), one.digits) for one in QUANTITIES.values()]
        for place, seed in enumerate(evaluation.seeds):
            cells = [_number(values[place], n) if values else "-" for values, n in columns]
            rows.append([name, str(seed), *cells])
        robust = [
            "" if one.rate else _number(one.robust(evaluation), one.digits)
            for one in QUANTITIES.values()
        ]
        rows.append([name, "interquartile mean", *robust])
    return markdown(header, rows)


def significance_table(evaluations: dict[str, Evaluation], reference: str) -> str:
    """Differences from the reference, paired over scenes, with Bonferroni's correction."""
    others = {name: one for name, one in evaluations.items() if name != reference}
    comparisons = len(others) * len(QUANTITIES)
    header = ["system", *(one.title for one in QUANTITIES.values())]
    rows = []
    for name, evaluation in others.items():
        cells = []
        for quantity in QUANTITIES.values():
            test = quantity.test(evaluation, evaluations[reference], comparisons)
            if test is None or not test.n[0]:
                cells.append("-")
            elif math.isnan(test.p):
                cells.append(f"{test.difference:+.{quantity.digits}f} (n = {test.n[0]})")
            else:
                p = "p < .001" if test.p < 0.001 else f"p = {test.p:.3f}"
                cells.append(
                    f"{test.difference:+.{quantity.digits}f} "
                    f"[{test.low:+.{quantity.digits}f}, {test.high:+.{quantity.digits}f}] "
                    f"{significance_mark(test.p).replace('*', chr(92) + '*')} ({p}, "
                    f"d_z = {test.effect:+.2f}, n = {test.n[0]})"
                )
        rows.append([f"{name} - {reference}", *cells])
    return markdown(header, rows)


def report(evaluations: dict[str, Evaluation], reference: str = "OUR") -> str:
    """All tables of a condition, in Markdown, with what their numbers mean."""
    first = next(iter(evaluations.values()))
    order = [reference, *paper.TABLE]
    names = sorted(evaluations, key=lambda n: (order.index(n) if n in order else len(order), n))
    evaluations = {name: evaluations[name] for name in names}
    parts = [
        f"## {first.condition}: {first.summary['episodes']} scenes "
        f"(seed {first.summary['scene_seed']})",
        "Value [95 % interval] (n). SR, CR and TR: success, collisions and timeouts over all "
        "preferences and training seeds, Wilson intervals for as many episodes as the scenes are "
        "worth. Others: one preference, bootstrap over scenes and, of several, training seeds. Time: "
        "successful episodes. Free way: scenes in which no box stands on the demonstrated path."
        + " The paper's numbers are of its own simulation."
        * (first.condition == paper.CONDITION),
        main_table(evaluations),
        "Time at efficiency = 1 as a multiple of what the straight line, or the shortest way around "
        "boxes and a standing human, takes at full speed. Rho: Spearman's rank correlation of a "
        "weight with the metric that it steers, mean of the edges of the simplex on which it varies. "
        "Hypervolume above 0 and expected utility of the objectives scaled to [0, 1] "
        "(`recipes.results.comparison.goodness`).",
        bounds_table(evaluations),
        seeds_table(evaluations),
    ]
    if reference in evaluations and len(evaluations) > 1:
        parts += [
            f"Difference from {reference} [95 % interval], paired t-test over scenes (each with its "
            "mean over training seeds and preferences), p and interval corrected for "
            f"{(len(evaluations) - 1) * len(QUANTITIES)} comparisons (Bonferroni): \\*\\*\\* p < .001, "
            "\\*\\* p < .01, \\* p < .05.",
            significance_table(evaluations, reference),
        ]
    return "\n\n".join(parts) + "\n"


def main() -> None:
    """Write and print the tables; ``--help`` lists the options."""
    parser = Parser(description=__doc__)
    parser.add_argument("directory", type=Path, help="what recipes.results.evaluate wrote")
    parser.add_argument("--condition", nargs="+", help="default: all that are there")
    parser.add_argument("--reference", default="OUR", help="system that others are tested against")
    args = parser.parse_args()
    conditions = args.condition
    if not conditions:
        conditions = sorted(
            {path.parent.name for path in args.directory.glob("[!.]*/[!.]*/summary.json")}
        )
    try:
        parts = [
            report(read_evaluations(args.directory, name), args.reference)
            for name in conditions or ["static"]
        ]
    except (FileNotFoundError, ValueError) as error:
        parser.error(str(error))
    text = "\n".join(parts)
    file = args.directory / "table.md"
    try:
        file.write_text(text)
    except OSError as error:
        parser.error(f"{file} cannot be written: {error.strerror}.")
    print(f"{text}\nwritten to {file}")


def _number(value: float | None, digits: int, *, sign: bool = False) -> str:
    if value is None or math.isnan(value):
        return "-"
    return f"{value:+.{digits}f}" if sign else f"{value:.{digits}f}"


if __name__ == "__main__":
    main()
