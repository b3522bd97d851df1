"""Arguments of components: what is wrong with one is said when it is given, not in the first batch."""

from __future__ import annotations

import math
import numbers
import reprlib
from collections.abc import Sequence

from tensordict.utils import NestedKey

from torchrl_morl.preferences import PreferenceSpace

__all__ = ["check_count", "check_positive", "check_preference_space", "check_sizes", "key_list"]


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
    real = isinstance(value, numbers.Real) and not isinstance(value, bool)
    if not (real and 0 < value < math.inf):
        raise ValueError(f"{name} must be positive and finite, got {reprlib.repr(value)}.")


def check_preference_space(value: object) -> None:
    """Raise ``ValueError`` unless it is a :class:`~torchrl_morl.preferences.PreferenceSpace`."""
    if not isinstance(value, PreferenceSpace):
        raise ValueError(f"preference_space must be a PreferenceSpace, got {reprlib.repr(value)}.")


def key_list(keys: NestedKey | Sequence[NestedKey]) -> list[NestedKey]:
    """The keys in a list; a string is one key, not its letters.

    Example:
        >>> key_list("scan"), key_list(("scan", ("next", "scan")))
        (['scan'], ['scan', ('next', 'scan')])
    """
    return [keys] if isinstance(keys, str) else list(keys)
