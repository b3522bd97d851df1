"""JSON that somebody else wrote: entries with the types that they must have."""

from __future__ import annotations

import contextlib
import json
import math
import reprlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

_MAX_DEPTH = 64


@contextlib.contextmanager
def named(where: str) -> Iterator[None]:
    """What refuses values of a file names the file that they stand in."""
    try:
        yield
    except ValueError as error:
        message = str(error)
        raise ValueError(message if message.startswith(where) else f"{where}: {message}") from error


def parse_json(text: bytes | str, where: str) -> Any:
    """JSON as the standard has it: no NaN, no infinity, and no more than 64 levels.

    Raises:
        ValueError: if it is none.
    """

    def refuse(name: str) -> None:
        raise ValueError(f"{name} is no JSON number")

    try:
        value = json.loads(text, parse_constant=refuse, object_pairs_hook=_once)
    except RecursionError:
        raise ValueError(f"{where} is not valid JSON: nested too deeply.") from None
    except ValueError as error:
        raise ValueError(f"{where} is not valid JSON: {one_line(error)}.") from error
    level = [value]
    for _ in range(_MAX_DEPTH):
        level = [
            item
            for entry in level
            if isinstance(entry, (dict, list))
            for item in (entry.values() if isinstance(entry, dict) else entry)
        ]
        if not level:
            return value
    raise ValueError(f"{where} is not valid JSON: nested too deeply.")


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object whose entries have different names: of two, readers would take one or the other."""
    values = dict(pairs)
    if len(values) < len(pairs):
        twice = Counter(name for name, _ in pairs).most_common(1)[0][0]
        raise ValueError(f"{reprlib.repr(twice)} stands there twice")
    return values


class Entries(Mapping):
    """The entries of a JSON object, each with the type that it must have.

    Args:
        values: as they were read.
        where: what messages call the object.
    """

    def __init__(self, values: Mapping[str, Any], where: str) -> None:
        self._values, self.where = values, where

    def __getitem__(self, name: str) -> Any:
        if name not in self._values:
            raise ValueError(f"{self.where} lacks {name!r}.")
        return self._values[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def __contains__(self, name: object) -> bool:
        return name in self._values

    def get(self, name: str, default: Any = None) -> Any:
        return self._values.get(name, default)

    def refused(self, name: str, allowed: str) -> ValueError:
        """The error for an entry that is something else than what is allowed."""
        return ValueError(
            f"{self.where}: {name} must be {allowed}, got {reprlib.repr(self._values[name])}."
        )

    def integer(self, name: str, low: int = 1, high: int = 2**24) -> int:
        """A whole number."""
        value = self[name]
        if type(value) is not int or not low <= value <= high:
            raise self.refused(name, f"an integer between {low} and {high}")
        return value

    def integers(self, name: str) -> tuple[int, ...]:
        """A list of positive numbers."""
        value = self[name]
        if type(value) is not list or not all(type(n) is int and 0 < n <= 2**24 for n in value):
            raise self.refused(name, f"a list of integers between 1 and {2**24}")
        return tuple(value)

    def number(self, name: str) -> float:
        """A finite number."""
        return self.numbers(name, length=None)[0]

    def numbers(self, name: str, length: int | None) -> tuple[float, ...]:
        """A list of so many finite numbers; ``None`` for a number alone."""
        value = self[name]
        values = [value] if length is None else value
        if (
            type(values) is not list
            or len(values) != (length or 1)
            or not all(type(n) in (int, float) and abs(n) < 1e300 for n in values)
        ):
            raise self.refused(
                name, "a finite number" if length is None else f"{length} finite numbers"
            )
        return tuple(float(n) for n in values)

    def flag(self, name: str) -> bool:
        """True or false."""
        value = self[name]
        if type(value) is not bool:
            raise self.refused(name, "true or false")
        return value

    def text(self, name: str) -> str:
        """A printable string."""
        value = self[name]
        if type(value) is not str or not value or not value.isprintable():
            raise self.refused(name, "a printable, non-empty string")
        return value

    def texts(self, name: str) -> tuple[str, ...]:
        """A list of printable strings."""
        value = self[name]
        if type(value) is not list or not all(
            type(text) is str and text and text.isprintable() for text in value
        ):
            raise self.refused(name, "a list of printable, non-empty strings")
        return tuple(value)

    def choice(self, name: str, allowed: Sequence[str]) -> str:
        """One of the strings."""
        value = self[name]
        if type(value) is not str or value not in allowed:
            raise self.refused(name, f"one of {', '.join(allowed)}")
        return value

    def object(self, name: str) -> Entries:
        """An object within."""
        value = self[name]
        if type(value) is not dict:
            raise self.refused(name, "an object")
        return Entries(value, f"{self.where}: {name}")

    def plain(self, name: str) -> dict[str, Any]:
        """An object of anything; empty if it is missing."""
        return dict(self.object(name)) if name in self else {}


def one_line(error: object) -> str:
    """The message of an error in one short line, without the dot at its end."""
    text = " ".join(str(error).split())
    return (text if len(text) <= 200 else f"{text[:200]}...").removesuffix(".")


def null_for_nan(value: Any) -> Any:
    """JSON knows neither NaN nor infinity: they become null."""
    if isinstance(value, dict):
        return {key: null_for_nan(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [null_for_nan(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
