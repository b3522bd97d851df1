"""Boxes around recorded trajectories, in a CSV file of their own."""

from __future__ import annotations

import difflib
from collections import defaultdict
from collections.abc import Collection
from pathlib import Path

import numpy as np

from ..fields import shown
from .recordings import BOX_COLUMNS, box_fault
from .tables import Table


class BoxFile:
    """The boxes of a ``.csv`` file, by the names of the trajectories that they stand around.

    Args:
        path: the file; ``None``: there are no boxes.
        drives: the file of the trajectories, for messages.
        names: of the trajectories.

    Raises:
        ValueError: if the file is not of this format, or a box belongs to no trajectory.
    """

    def __init__(self, path: Path | None, drives: Path, names: Collection[str]) -> None:
        self._boxes: dict[str, list[list[float]]] = defaultdict(list)
        self._faults: dict[str, list[str]] = defaultdict(list)
        if path is None:
            return
        table = Table(path, BOX_COLUMNS)
        for line in table:
            place = f"{path}, line {line.number}"
            # Which trajectory such a line belongs to is a guess, and a robot would miss its box.
            if line.fault:
                raise ValueError(f"{path}, {line.fault}.")
            if line.trajectory not in names:
                close = difflib.get_close_matches(line.trajectory, list(names), 1)
                hint = f" Is {close[0]!r} meant?" if close else ""
                raise ValueError(
                    f"{place}: {drives} has no trajectory {shown(line.trajectory)}.{hint}"
                )
            numbers = table.numbers(line)
            if isinstance(numbers, str):
                self._faults[line.trajectory].append(f"{path}, {numbers}")
                continue
            values = dict(zip(table.columns, numbers))
            box = [values[column] for column in BOX_COLUMNS]
            fault = box_fault(box, place)
            if fault:
                self._faults[line.trajectory].append(fault)
                continue
            self._boxes[line.trajectory].append(box)
        # A box that is left out is one that the robot would not see.
        if table.cut_off:
            raise ValueError(f"{path}, line {table.cut_off} is cut off: complete or remove it.")

    def around(self, name: str) -> np.ndarray:
        """``[M, 5]`` of a trajectory: x, y, yaw, half length, half width."""
        return np.array(self._boxes.get(name, []), dtype=np.float64).reshape(-1, 5)

    def faults(self, name: str) -> list[str]:
        """What could not be read of the boxes of a trajectory."""
        return self._faults.get(name, [])
