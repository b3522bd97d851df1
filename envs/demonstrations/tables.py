"""Lines of a CSV file with a header, and what of them cannot be read."""

from __future__ import annotations

import codecs
import csv
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from ..fields import shown
from .recordings import LONGEST_NAME

# What people write into a cell that has no number.
_EMPTY = ("", "-", "na", "n/a", "none", "null")

_NAMES = {",": "commas", ";": "semicolons", "\t": "tabs"}


class Line(NamedTuple):
    """A line of a table: its number, the trajectory that it belongs to, and its cells or a fault."""

    number: int
    trajectory: str
    cells: list[str]
    fault: str | None


class Table:
    """A text file of comma, semicolon or tab separated columns, one of which is ``trajectory``.

    Blank lines, comments (``#``) and headers that repeat the first one are passed over. A line
    that cannot be split belongs to the trajectory that it names; where it names none, to that of
    the line before.

    Args:
        path: the file, UTF-8.
        required: columns that the header must name, beside ``trajectory``.
        optional: columns that it may name.

    Raises:
        ValueError: if the file is no text. Reading raises it, too: for a header of other columns,
            and for a line that is not UTF-8.
    """

    def __init__(self, path: Path, required: Sequence[str], optional: Sequence[str] = ()) -> None:
        with path.open("rb") as file:
            start = file.read(4096)
        if start.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
            raise ValueError(f"{path} is UTF-16: save it as UTF-8.")
        if start.startswith(b"\x1f\x8b"):
            raise ValueError(f"{path} is compressed by gzip: unpack it first.")
        if b"\0" in start:
            raise ValueError(f"{path} is not a text file: save it as CSV in UTF-8.")
        self.path, self.required, self.optional = path, tuple(required), tuple(optional)
        self.delimiter, self.columns = ",", ()
        self._forget()

    def _forget(self) -> None:
        self._header: list[str] = []
        self.comments = self.headers = 0
        self.cut_off: int | None = None

    def notes(self) -> list[str]:
        """What the last reading passed over."""
        counts = ((self.comments, "comment line(s)"), (self.headers, "repeated header(s)"))
        notes = [f"left out {count} {what}" for count, what in counts if count]
        if self.cut_off:
            notes.append(f"left out line {self.cut_off}, which is cut off")
        return notes

    def __iter__(self) -> Iterator[Line]:
        self._forget()
        name, orphans = "", []
        for number, text in self._texts():
            if not self._header:
                self._find_header(number, text)
                continue
            if text.startswith("#"):
                self.comments += 1
                continue
            line = self._line(number, text.rstrip("\n"))
            if line is None:
                continue
            # Only the last line can lack its end: a recorder was stopped while it wrote.
            if not text.endswith("\n") and isinstance(self.numbers(line), str):
                self.cut_off = number
                continue
            name = line.trajectory or name
            if not name:
                orphans.append(line)
                continue
            yield from (orphan._replace(trajectory=name) for orphan in orphans)
            orphans = []
            yield line if line.trajectory else line._replace(trajectory=name)
        if not self._header:
            what = "holds nothing but comments" if self.comments else "is empty"
            columns = ",".join(["trajectory", *self.required])
            raise ValueError(
                f"{self.path} {what}: it needs a header, {columns}, and lines below it."
            )
        if orphans:
            raise ValueError(f"{self.path}, {orphans[0].fault}.")

    def numbers(self, line: Line) -> list[float] | str:
        """The numbers of :attr:`columns`, or what is wrong with the line.

        An empty cell of an optional column is NaN.
        """
        if line.fault:
            return line.fault
        try:
            return [float(line.cells[index]) for index in self._indices]
        except ValueError:
            pass
        values = []
        for column, index in zip(self.columns, self._indices):
            cell = line.cells[index]
            if column in self.optional and cell.lower() in _EMPTY:
                cell = "nan"
            # Where commas separate no columns they are decimal.
            decimal = cell.replace(",", ".") if self.delimiter != "," else cell
            try:
                values.append(float(decimal))
            except ValueError:
                what = f"{shown(cell)} is not a number" if cell else "the cell is empty"
                hint = ", numbers have decimal points" if "," in cell else ""
                return f"line {line.number}, column {column}: {what}{hint}"
        return values

    # --- lines -----------------------------------------------------------------------------------

    def _texts(self) -> Iterator[tuple[int, str]]:
        """Number and text of the lines that are not blank."""
        with self.path.open(encoding="utf-8", errors="surrogateescape") as file:
            for number, text in enumerate(file, 1):
                if not text.isascii():
                    try:
                        text.encode()
                    except UnicodeEncodeError:
                        raise ValueError(
                            f"{self.path}, line {number} is not UTF-8: save the file as CSV in UTF-8."
                        ) from None
                    # Spreadsheet programs put a byte order mark in front of the header.
                    text = text.lstrip("\ufeff")
                text = text.lstrip(" ")
                if text.strip():
                    yield number, text

    def _line(self, number: int, text: str) -> Line | None:
        """The line, or ``None`` where it says nothing."""
        header, place = self._header, f"line {number}"
        try:
            cells = _split(text, self.delimiter)
        except csv.Error as error:
            return Line(number, "", [], f"{place}: {error}")
        if not any(cells):
            return None
        if cells[: len(header)] == header:
            self.headers += 1
            return None
        if "trajectory" in cells and set(self.required) <= set(cells):
            raise ValueError(f"{self.path}, {place}: a second header, with other columns.")
        while len(cells) > len(header) and not cells[-1]:
            cells.pop()
        column = header.index("trajectory")
        if len(cells) != len(header):
            # Cells that are too many or too few shift all but the first.
            name = _in_a_line(cells[0]) if column == 0 and len(cells) > 1 else ""
            fault = f"{place}: {len(cells)} cells, but {len(header)} columns"
            if self.delimiter == "," and len(cells) > len(header):
                fault += " (for decimal commas, separate the columns with semicolons)"
            return Line(number, name, cells, fault)
        name, fault = cells[column], None
        if not name:
            fault = f"{place}, column trajectory: the cell is empty"
        elif not name.isprintable() or len(name) > LONGEST_NAME:
            name = _in_a_line(name)
            fault = (
                f"{place}, column trajectory: {name} is no name of up to {LONGEST_NAME} characters"
            )
        # Python reads 1_0 as ten, which no recorder means.
        elif "_" in text and any("_" in cells[index] for index in self._indices):
            fault = f"{place}: an underscore in a number"
        return Line(number, name, cells, fault)

    # --- header ----------------------------------------------------------------------------------

    def _find_header(self, number: int, text: str) -> None:
        # numpy.savetxt writes the header as a comment, Excel a line sep=; in front of it.
        bare = text.strip("# \n")
        self.delimiter = max(_NAMES, key=bare.count)
        try:
            header = _split(bare, self.delimiter)
        except csv.Error:
            header = []
        while header and not header[-1]:
            header.pop()
        expected = ["trajectory", *self.required]
        named = set(expected) <= set(header)
        if not named and text.startswith("#"):
            self.comments += 1
            return
        if text.lower().startswith("sep="):
            return
        unknown = set(header) - {*expected, *self.optional}
        if not named or unknown or len(set(header)) < len(header):
            raise ValueError(self._wrong_header(number, header))
        self._header = header
        self.columns = tuple(name for name in header if name != "trajectory")
        self._indices = [header.index(name) for name in self.columns]

    def _wrong_header(self, number: int, header: list[str]) -> str:
        expected = ["trajectory", *self.required]
        missing = [name for name in expected if name not in header]
        unknown = [name for name in header if name not in (*expected, *self.optional)]
        twice = sorted(name for name, times in Counter(header).items() if times > 1)
        return (
            f"{self.path}, line {number}: the header must name the columns {','.join(expected)}"
            f"{''.join(f' and may name {name}' for name in self.optional)}, each once, separated by "
            f"commas, semicolons or tabs; missing: {missing}, unknown: {shown(unknown)}, twice: {shown(twice)}."
        )


def _in_a_line(name: str) -> str:
    """A name that reports can show: others in quotes, cut short."""
    return name if name.isprintable() and len(name) <= LONGEST_NAME else shown(name)


def _split(text: str, delimiter: str) -> list[str]:
    """The cells of a line, without the spaces around them."""
    if '"' in text:
        # Strictly: a quote that is not closed would swallow the lines after it.
        (cells,) = csv.reader([text], delimiter=delimiter, skipinitialspace=True, strict=True)
    else:
        cells = text.split(delimiter)
    return [cell.strip() for cell in cells]
