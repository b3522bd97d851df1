"""The quantitative and the qualitative figure of the paper from the evaluations in a folder.

Example::

    python -m recipes.results.figures runs/results
    python -m recipes.results.figures runs/results --scenes static=3,8 moving_human=0,4 corridor=2
"""

from __future__ import annotations

from pathlib import Path

from ..arguments import Parser
from .files import SUMMARY, Evaluation, read_evaluation
from .panels import Column
from .qualitative import pick_scenes, qualitative_figure
from .quantitative import quantitative_figure

SHOWN = {"static": 2, "moving_human": 2, "corridor": 1}
"""Conditions of the qualitative figure and how many scenes of each it shows."""


def parse_scenes(texts: list[str]) -> dict[str, list[int]]:
    """Scene indices by condition, written as ``static=3,8``.

    Raises:
        ValueError: if it is written otherwise.
    """
    scenes = {}
    for text in texts:
        name, _, numbers = text.partition("=")
        try:
            scenes[name] = [int(number) for number in numbers.split(",")]
        except ValueError as error:
            raise ValueError(f"--scenes: write CONDITION=3,8, got {text!r}.") from error
    return scenes


def choose_columns(
    evaluations: dict[str, Evaluation], scenes: dict[str, list[int]]
) -> list[Column]:
    """Columns A, B ... of the qualitative figure.

    Raises:
        ValueError: for a scene or a condition that was not evaluated.
    """
    missing = scenes.keys() - evaluations.keys()
    if missing:
        raise ValueError(f"--scenes: {', '.join(sorted(missing))} was not evaluated.")
    columns: list[Column] = []
    for condition, evaluation in evaluations.items():
        chosen = scenes.get(condition) or pick_scenes(evaluation, SHOWN.get(condition, 1))
        for scene in chosen:
            if not 0 <= scene < evaluation.summary["episodes"]:
                raise ValueError(f"--scenes: {condition} has no scene {scene}.")
            title = f"{'ABCDEFGHIJ'[len(columns)]}: {condition.replace('_', ' ')} ({scene})"
            columns.append(Column(evaluation, scene, title))
    return columns


def main() -> None:
    """Draw the figures; ``--help`` lists the options."""
    parser = Parser(description=__doc__)
    parser.add_argument("directory", type=Path, help="what recipes.results.evaluate wrote")
    parser.add_argument("--system", default="OUR", help="whose figures")
    parser.add_argument("--core", default="CORE", help="system without preferences, if it is there")
    parser.add_argument("--condition", default="static", help="of the quantitative figure")
    parser.add_argument(
        "--scenes", nargs="+", default=[], metavar="CONDITION=I,J", help="default: chosen"
    )
    args = parser.parse_args()
    folder, core_folder = args.directory / args.system, args.directory / args.core / args.condition
    try:
        quantitative = read_evaluation(folder / args.condition)
        core = read_evaluation(core_folder) if (core_folder / SUMMARY).is_file() else None
        there = [name for name in SHOWN if (folder / name / SUMMARY).is_file()]
        evaluations = {name: read_evaluation(folder / name) for name in there}
        columns = choose_columns(evaluations, parse_scenes(args.scenes))
        files = [args.directory / f"{args.system}_{name}.png" for name in NAMES]
        quantitative_figure(files[0], quantitative, core)
        if columns:
            qualitative_figure(files[1], columns)
    except (FileNotFoundError, ValueError) as error:
        parser.error(str(error))
    print(f"written: {', '.join(str(file) for file in files if file.is_file())}")
    for name in SHOWN:
        if name not in there:
            print(f"without {name}: python -m recipes.results.evaluate ... --condition {name}")


NAMES = ("quantitative", "qualitative")


if __name__ == "__main__":
    main()
