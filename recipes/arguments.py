"""Types of command-line arguments: what is wrong is one line with the value and what is allowed.

::

    parser.add_argument("--episodes", type=count(most=100_000), default=100)
"""

from __future__ import annotations

import argparse
import errno
import math
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

from envs.fields import shown
from envs.places import no_file, no_folder


class Parser(argparse.ArgumentParser):
    """Shows a module's docstring as it is, and a mistake as one line.

    Examples:
        >>> Parser(prog="evaluate").parse_args(["--scen"])
        Traceback (most recent call last):
        SystemExit: 2
    """

    def __init__(self, **kwargs: Any) -> None:
        # evaluate.py would be two commands.
        spec = getattr(sys.modules["__main__"], "__spec__", None)
        if spec is not None and spec.name.partition(".")[0] in (
            "recipes",
            "benchmarks",
            "examples",
        ):
            kwargs.setdefault("prog", f"python -m {spec.name.removesuffix('.__main__')}")
        kwargs.setdefault("formatter_class", argparse.RawDescriptionHelpFormatter)
        super().__init__(**kwargs)
        self.register("type", Path, some_path)

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: error: {message}\n")

    def changed(self, args: argparse.Namespace) -> set[str]:
        """Arguments that are not their defaults.

        Examples:
            >>> parser = Parser(prog="evaluate")
            >>> _ = parser.add_argument("--episodes", type=int, default=100)
            >>> (
            ...     parser.changed(parser.parse_args([])),
            ...     parser.changed(parser.parse_args(["--ep", "5"])),
            ... )
            (set(), {'episodes'})
        """
        return {name for name, value in vars(args).items() if value != self.get_default(name)}


def count(least: int = 1, most: int | None = None) -> Callable[[str], int]:
    """A whole number in a range.

    Args:
        least: the smallest.
        most: the largest; ``None`` for no end.

    Returns:
        A type for ``add_argument``.

    Examples:
        >>> count(most=100_000)("20")
        20
        >>> count(most=100)("101")
        Traceback (most recent call last):
        argparse.ArgumentTypeError: must be a whole number from 1 to 100, got '101'
    """
    allowed = f"at least {least}" if most is None else f"from {least} to {most}"

    def parse(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = None
        if value is None or value < least or (most is not None and value > most):
            raise argparse.ArgumentTypeError(f"must be a whole number {allowed}, got {text!r}")
        return value

    return parse


positive_int = count()
"""A whole number from one."""

episodes = count(most=100_000)
"""How many episodes, all in memory at once."""

seed = count(0, 2**31 - 1)
"""Of random generators; what runs in several parts adds to it."""


def number(
    least: float = -math.inf, most: float = math.inf, *, above: float = -math.inf
) -> Callable[[str], float]:
    """A finite number in a range.

    Args:
        least: the smallest.
        most: the largest.

    Keyword Args:
        above: what it must exceed.

    Returns:
        A type for ``add_argument``.

    Examples:
        >>> number(0, 1)("0.5"), positive("2")
        (0.5, 2.0)
        >>> positive("0")
        Traceback (most recent call last):
        argparse.ArgumentTypeError: must be a number above 0, got '0'
    """
    parts = [
        f"above {above:g}" if above > -math.inf else "",
        f"from {least:g}" if least > -math.inf else "",
        f"to {most:g}" if most < math.inf else "",
    ]
    allowed = " ".join(part for part in parts if part)

    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not (math.isfinite(value) and least <= value <= most and value > above):
            raise argparse.ArgumentTypeError(
                f"must be a number {allowed}".rstrip() + f", got {text!r}"
            )
        return value

    return parse


positive = number(above=0)
"""A number above zero."""

share = number(0, 1)
"""From nothing to all."""


def some_path(text: str) -> Path:
    """Anything but nothing, which would be the current folder: an unset variable of a shell.

    Examples:
        >>> some_path("")
        Traceback (most recent call last):
        argparse.ArgumentTypeError: must be a path, got '': . is the current folder
    """
    if not text:
        raise argparse.ArgumentTypeError(f"must be a path, got {text!r}: . is the current folder")
    try:
        os.lstat(text)
    except (OSError, ValueError) as error:
        # What is not there may be made; no folder can hold other names.
        if isinstance(error, ValueError) or error.errno == errno.ENAMETOOLONG:
            why = getattr(error, "strerror", None) or error
            raise argparse.ArgumentTypeError(f"must be a path, got {shown(text)}: {why}") from error
    return Path(text)


def existing_file(text: str) -> Path:
    """A file that is there."""
    path = some_path(text)
    if what := no_file(path):
        raise argparse.ArgumentTypeError(f"must be a file, {text!r} {what}")
    return path


def existing_folder(text: str) -> Path:
    """A folder that is there."""
    path = some_path(text)
    if what := no_folder(path):
        raise argparse.ArgumentTypeError(f"must be a folder, {text!r} {what}")
    return path


def existing(text: str) -> Path:
    """A file or a folder that is there."""
    path = some_path(text)
    if (what := no_file(path)) and no_folder(path):
        raise argparse.ArgumentTypeError(f"must be a file or a folder, {text!r} {what}")
    return path


def new_folder(text: str) -> Path:
    """A folder to write: not there, or empty."""
    path = some_path(text)
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise argparse.ArgumentTypeError(
            f"{text!r} exists and is not overwritten: choose another folder"
        )
    return path


def new_file(text: str) -> Path:
    """A file to write: not there."""
    path = some_path(text)
    if path.exists():
        raise argparse.ArgumentTypeError(f"{text!r} exists and is not overwritten: choose another")
    return path
