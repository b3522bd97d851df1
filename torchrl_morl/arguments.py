"""Arguments of components: what is wrong with one is said when it is given, not in the first batch."""

from __future__ import annotations

import math
import numbers
import reprlib
from collections.abc import Sequence

import torch
from tensordict.utils import NestedKey

__all__ = [
    "MOST_SEED",
    "check_count",
    "check_device",
    "check_flag",
    "check_positive",
    "check_seed",
    "check_sizes",
    "is_number",
    "key_list",
    "shown",
]


_MOST_WEIGHTS = 2**30
"""Of a layer: 4 GB in single precision."""

MOST_SEED = 2**63 - 2
"""Some components seed a second generator with the number behind it."""


def shown(value: object, writer: reprlib.Repr = reprlib.aRepr) -> str:
    """A value in one short line, whatever it is; ``writer`` says how short.

    Example:
        >>> shown(10**5000)
        'an int of more digits than can be shown'
    """
    try:
        return " ".join(writer.repr(value).split())
    except ValueError:  # Python refuses to write more than 4,300 digits
        return f"an {type(value).__name__} of more digits than can be shown"


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


def check_count(name: str, value: object, least: int = 1, most: int | None = None) -> None:
    """Raise ``ValueError`` unless it is a whole number from ``least`` on, and not beyond ``most``.

    Example:
        >>> check_count("num_sectors", 1.5)
        Traceback (most recent call last):
        ...
        ValueError: num_sectors must be a whole number, at least 1, got 1.5.
    """
    if not isinstance(value, numbers.Integral) or isinstance(value, bool):
        raise ValueError(f"{name} must be a whole number, at least {least}, got {shown(value)}.")
    if value < least:
        raise ValueError(f"{name} must be at least {least}, got {shown(value)}.")
    if most is not None and value > most:
        raise ValueError(f"{name} must be at most {most:,}, got {shown(value)}.")


def check_sizes(in_features: int, num_cells: Sequence[int]) -> None:
    """Raise ``ValueError`` unless a network has at least one input, one cell in every layer, and room for them."""
    check_count("in_features", in_features)
    if isinstance(num_cells, str) or not isinstance(num_cells, Sequence):
        raise ValueError(f"num_cells must be a list of whole numbers, got {shown(num_cells)}.")
    before = in_features
    for index, size in enumerate(num_cells):
        check_count(f"num_cells[{index}]", size)
        if before * size > _MOST_WEIGHTS:
            raise ValueError(
                f"num_cells[{index}] makes a layer of {shown(before)} x {shown(size)} weights, at most "
                f"{_MOST_WEIGHTS:,} are allowed."
            )
        before = size


def check_seed(seed: object) -> None:
    """Raise ``ValueError`` unless a generator can begin with it; ``None`` is any.

    Example:
        >>> check_seed("a")
        Traceback (most recent call last):
        ...
        ValueError: seed must be a whole number, at least 0, got 'a'.
    """
    if seed is not None:
        check_count("seed", seed, least=0, most=MOST_SEED)


def check_flag(name: str, value: object) -> None:
    """Raise ``ValueError`` unless it is ``True`` or ``False``.

    Example:
        >>> check_flag("snapshots", "no")
        Traceback (most recent call last):
        ...
        ValueError: snapshots must be True or False, got 'no'.
    """
    if not isinstance(value, bool):
        raise ValueError(f"{name} must be True or False, got {shown(value)}.")


def check_device(name: str, value: object, *, holds_values: bool = True) -> None:
    """Raise ``ValueError`` unless PyTorch can put tensors there; ``None`` is wherever they are.

    Example:
        >>> check_device("device", "meta")
        Traceback (most recent call last):
        ...
        ValueError: device must be one that holds values, such as 'cpu', got 'meta'.
    """
    if value is None:
        return
    try:
        made = torch.empty(0, device=value)
    except (RuntimeError, AssertionError, TypeError, ValueError, ImportError) as error:
        why = next(iter(str(error).splitlines()), type(error).__name__)
        raise ValueError(
            f"{name} must be one that PyTorch {torch.__version__} finds here, such as 'cpu', got "
            f"{shown(value)}: {why[:100]}"
        ) from error
    if made.is_meta and holds_values:
        raise ValueError(
            f"{name} must be one that holds values, such as 'cpu', got {shown(value)}."
        )


def check_positive(name: str, value: object) -> None:
    """Raise ``ValueError`` unless it is a real number above zero, and finite."""
    if not (is_number(value) and value > 0):
        raise ValueError(f"{name} must be positive and finite, got {shown(value)}.")


def key_list(keys: NestedKey | Sequence[NestedKey]) -> list[NestedKey]:
    """The keys in a list; a string is one key, not its letters.

    Example:
        >>> key_list("scan"), key_list(("scan", ("next", "scan")))
        (['scan'], ['scan', ('next', 'scan')])
    """
    return [keys] if isinstance(keys, str) else list(keys)
