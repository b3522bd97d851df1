"""Numbers, ranges and boxes in the files of scenes: reading them, and refusing them in one line."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from torchrl_morl.arguments import is_number

from .fields import Fields, is_list, number_hint
from .scenes import MOST_BOXES

# Coordinates and sizes beyond are millimetres by mistake, angles beyond are degrees.
_FARTHEST = 100.0
METRES = (-_FARTHEST, _FARTHEST)
RADIANS = (-2 * math.pi, 2 * math.pi)

FASTEST = 3.0
"""Of people, m/s."""

Range = tuple[float, float]

_BOX_FIELDS = ("at", "yaw", "size")


def read_boxes(fields: Fields) -> list[list[Range]]:
    """The five numbers of each box as in :class:`Scene`, with half lengths and widths."""
    boxes = fields.values.get("boxes", [])
    if not is_list(boxes):
        raise fields.refusal("boxes", "a list of {at, yaw, size}", boxes)
    if len(boxes) > MOST_BOXES:
        raise ValueError(
            f"{fields.where}: boxes must be at most {MOST_BOXES:,}, got {len(boxes):,}."
        )
    out = []
    for index, box in enumerate(boxes):
        at = f"boxes[{index}]"
        if not isinstance(box, Mapping):
            raise fields.refusal(at, "fields {at, yaw, size}", box)
        fields.refuse_unknown(box, _BOX_FIELDS, f" of {at}")
        x, y = read_numbers(fields, "at", ("x", "y"), (METRES, METRES), box, at)
        yaw = read_number(fields, f"{at}.yaw", box.get("yaw", 0.0), RADIANS, "radians")
        limits = ((0.0, _FARTHEST),) * 2
        length, width = read_numbers(fields, "size", ("length", "width"), limits, box, at)
        length, width = ((low / 2, high / 2) for low, high in (length, width))
        out.append([x, y, yaw, length, width])
        if out[-1] in out[:-1] and all(low == high for low, high in out[-1]):
            raise ValueError(f"{fields.where}: {at} is boxes[{out.index(out[-1])}] once more.")
    return out


def read_numbers(
    fields: Fields,
    field: str,
    names: tuple[str, ...],
    limits: tuple[Range, ...],
    values: Mapping[str, Any] | None = None,
    at: str = "",
) -> list[Range]:
    """Ranges of the numbers of a field, one a name.

    Raises:
        ValueError: for a field that is missing or refused.
    """
    values = fields.values if values is None else values
    title = f"{at}.{field}" if at else field
    what = f"[{', '.join(names)}], each a number or a range [low, high]"
    if field not in values:
        raise ValueError(f"{fields.where}: {title} is missing: {what}.")
    value = values[field]
    if not is_list(value) or len(value) != len(names):
        raise fields.refusal(title, what, value)
    return [
        read_number(
            fields, f"{name} of {title}", one, ends, "radians" if ends is RADIANS else "metres"
        )
        for name, one, ends in zip(names, value, limits)
    ]


def read_number(fields: Fields, title: str, value: Any, limits: Range, unit: str) -> Range:
    """A number, or a range of two."""
    low, high = limits
    ends = tuple(value) if is_list(value) else (value, value)
    sizes = low == 0
    allowed = f"a number of {unit} {'above 0' if sizes else f'from {low:.4g}'}"
    allowed += f"{' and at most' if sizes else ' to'} {high:.4g}, or a range [low, high] of two"
    bad = next((end for end in ends if not is_number(end)), None)
    if len(ends) != 2 or bad is not None:
        raise fields.refusal(title, allowed, value, number_hint(bad))
    if not all(low <= end <= high and (end > 0 or not sizes) for end in ends):
        degrees = unit == "radians" and all(abs(end) <= 360 for end in ends)
        hint = f"{ends[1]:g} degrees are {math.radians(ends[1]):.4g}." if degrees else ""
        raise fields.refusal(title, allowed, value, hint)
    if ends[0] > ends[1]:
        raise fields.refusal(title, "a range [low, high] in ascending order", value)
    return float(ends[0]), float(ends[1])
