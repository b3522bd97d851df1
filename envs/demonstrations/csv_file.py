"""Recorded trajectories in a CSV file, read one at a time."""

from __future__ import annotations

from array import array
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from .boxes import BoxFile
from .recordings import COLUMNS, Recording, make_recording
from .tables import Table


class CsvFile:
    """The trajectories of a ``.csv`` file, in the order in which their last lines come.

    The file is read twice. The first time tells where each trajectory ends, so that the second time
    needs memory for those only that are not at their end, which is one unless lines are interleaved.

    Args:
        path: the file.
        boxes: a second ``.csv`` file with the boxes around the trajectories.

    Raises:
        ValueError: if a file is not of this format, or a box belongs to no trajectory.
    """

    def __init__(self, path: Path, boxes: Path | None = None) -> None:
        self._table = Table(path, COLUMNS, ("heading",))
        self._ends = {line.trajectory: line.number for line in self._table}
        self.notes = self._table.notes()
        if not self._ends:
            raise ValueError(f"{path} holds no trajectory: there is nothing below the header.")
        self._boxes = BoxFile(boxes, path, self._ends)

    def __len__(self) -> int:
        return len(self._ends)

    def __iter__(self) -> Iterator[Recording]:
        unfinished: dict[str, _Points] = defaultdict(_Points)
        for line in self._table:
            name = line.trajectory
            unfinished[name].add(line.number, self._table.numbers(line))
            if line.number == self._ends.get(name):
                yield self._recording(name, unfinished.pop(name))
        # What somebody has appended between the two readings.
        for name, points in unfinished.items():
            yield self._recording(name, points)

    def _recording(self, name: str, points: _Points) -> Recording:
        columns = self._table.columns
        values = np.array(points.numbers).reshape(-1, len(columns)).T
        return make_recording(
            name,
            dict(zip(columns, values)),
            self._boxes.around(name),
            where="line",
            rows=np.array(points.lines, dtype=np.int64),
            faults=[*points.faults(), *self._boxes.faults(name)],
        )


class _Points:
    """What was read of a trajectory so far: eight bytes a number."""

    def __init__(self) -> None:
        self.numbers, self.lines = array("d"), array("q")
        self._first, self._count = "", 0

    def add(self, line: int, numbers: list[float] | str) -> None:
        if isinstance(numbers, str):
            self._first, self._count = self._first or numbers, self._count + 1
            return
        self.numbers.extend(numbers)
        self.lines.append(line)

    def faults(self) -> list[str]:
        more = f", and {self._count - 1} more line(s)" if self._count > 1 else ""
        return [self._first + more] if self._first else []
