"""The file that a benchmark writes: a new one, looked at before anything is measured."""

from __future__ import annotations

import argparse
from pathlib import Path

from recipes.arguments import Parser
from recipes.outputs import choose_file


def parse_with_output(
    parser: Parser, arguments: list[str] | None, default: str
) -> argparse.Namespace:
    """The arguments, ``--output`` among them: a file that does not exist yet.

    Args:
        parser: with all other arguments.
        arguments: those of the command line if ``None``.
        default: name of the file in ``runs/benchmarks``; with a number at its end if it exists.
    """
    path = Path("runs/benchmarks") / default
    help = f"new file (default: {path}, else one with a number)"
    parser.add_argument("--output", type=Path, help=help)
    args = parser.parse_args(arguments)
    try:
        args.output = choose_file(args.output, path)
    except ValueError as error:
        parser.error(str(error))
    return args
