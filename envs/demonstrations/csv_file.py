"""Recorded trajectories in a CSV file, read one at a time."""

from __future__ import annotations

import difflib
from array import array
from collections import defaultdict
from collections.abc import Container, Iterator
from pathlib import Path

import numpy as np

from .recordings import BOX_COLUMNS, COLUMNS, Recording, box_fault, make_recording
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
        self._boxes: dict[str, list[list[float]]] = defaultdict(list)
        self._faults: dict[str, list[str]] = defaultdict(list)
        if boxes is not None:
            self._read_boxes(boxes, path, self._ends)

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
            np.array(self._boxes[name], dtype=np.float64).reshape(-1, 5),
            where="line",
            rows=np.array(points.lines, dtype=np.int64),
            faults=[*points.faults(), *self._faults[name]],
        )

    def _read_boxes(self, path: Path, drives: Path, names: Container[str]) -> None:
        table = Table(path, BOX_COLUMNS)
        for line in table:
            place = f"{path}, line {line.number}"
            # Which trajectory such a line belongs to is a guess, and a robot would miss its box.
            if line.fault:
                raise ValueError(f"{path}, {line.fault}.")
            if line.trajectory not in names:
                close = difflib.get_close_matches(line.trajectory, list(self._ends), 1)
                hint = f" Is {close[0]!r} meant?" if close else ""
                raise ValueError(f"{place}: {drives} has no trajectory {line.trajectory!r}.{hint}")
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
