"""Arguments of components: what is wrong with one is said when it is given, not in the first batch."""

from __future__ import annotations

import math
import numbers
import reprlib
from collections.abc import Sequence

from tensordict.utils import NestedKey

__all__ = ["check_count", "check_positive", "check_sizes", "is_number", "key_list"]


def is_number(value: object) -> bool:
    """Whether it is a finite real number; ``True`` and ``"1"`` are none.

    Example:
        >>> is_number(1), is_number(float("nan")), is_number(True), is_number(10**400)
        (True, False, False, False)
    """
    if isinstance(value, bool) or not isinstance(value, numbers.Real):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # an integer beyond all floats
        return False


def check_count(name: str, value: object, least: int = 1) -> None:
    """Raise ``ValueError`` unless it is a whole number from ``least`` on.

    Example:
        >>> check_count("num_sectors", 1.5)
        Traceback (most recent call last):
        ...
        ValueError: num_sectors must be a whole number, at least 1, got 1.5.
    """
    if not isinstance(value, numbers.Integral) or isinstance(value, bool):
        raise ValueError(
            f"{name} must be a whole number, at least {least}, got {reprlib.repr(value)}."
        )
    if value < least:
        raise ValueError(f"{name} must be at least {least}, got {value}.")


def check_sizes(in_features: int, num_cells: Sequence[int]) -> None:
    """Raise ``ValueError`` unless a network has at least one input, and one cell in every layer."""
    check_count("in_features", in_features)
    for index, size in enumerate(num_cells):
        check_count(f"num_cells[{index}]", size)


def check_positive(name: str, value: object) -> None:
    """Raise ``ValueError`` unless it is a real number above zero, and finite."""
    if not (is_number(value) and value > 0):
        raise ValueError(f"{name} must be positive and finite, got {reprlib.repr(value)}.")


def key_list(keys: NestedKey | Sequence[NestedKey]) -> list[NestedKey]:
    """The keys in a list; a string is one key, not its letters.

    Example:
        >>> key_list("scan"), key_list(("scan", ("next", "scan")))
        (['scan'], ['scan', ('next', 'scan')])
    """
    return [keys] if isinstance(keys, str) else list(keys)
