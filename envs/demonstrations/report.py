"""What became of the trajectories of a file, and why."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path


@dataclasses.dataclass(frozen=True)
class Reason:
    """Why a trajectory is rejected.

    Args:
        text: what is wrong, where: "drives at 0.80 m/s at 3.20 s, over 0.50 + 0.05 m/s in 4 step(s)".
        kind: what it has in common with other trajectories: "faster than turtlebot2's 0.5 m/s".
        hint: what to do; options as ``recipes.import_demonstrations`` names them.
        value: how far off it is, in the unit; the largest counts for all of a kind.
        unit: of the value.
    """

    text: str
    kind: str
    hint: str = ""
    value: float | None = None
    unit: str = ""

    def __str__(self) -> str:
        return self.text


def enough(excess: float) -> str:
    """The smallest number of two decimals that is not below the excess.

    Examples:
        >>> enough(0.8 - 0.5), enough(0.301), enough(2.0)
        ('0.3', '0.31', '2')
    """
    return f"{math.ceil(excess * 100 - 1e-4) / 100:g}"


@dataclasses.dataclass(frozen=True)
class ImportReport:
    """What became of the trajectories of a file.

    Args:
        accepted: names, in the order of the dataset's rows.
        rejected: names and all reasons of each.
        notes: what of the file was passed over, such as repeated points.
    """

    accepted: list[str]
    rejected: Mapping[str, Sequence[Reason]]
    notes: Sequence[str] = ()

    def summary(self) -> list[str]:
        """A line on each kind of reason, the most common one first.

        Examples:
            >>> slow = Reason(
            ...     "takes 350 steps", "longer than 300 steps", "--max-steps 350", 350, "steps"
            ... )
            >>> print(*ImportReport(["a"], {"b": [slow], "c": [slow]}).summary())
            2 of 3 drives longer than 300 steps (up to 350 steps): --max-steps 350
        """
        total = len(self.accepted) + len(self.rejected)
        kinds: dict[str, list[tuple[str, Reason]]] = {}
        for name, reasons in self.rejected.items():
            for reason in reasons:
                kinds.setdefault(reason.kind, []).append((name, reason))
        lines = []
        for kind, found in sorted(kinds.items(), key=lambda item: -len(item[1])):
            worst_name, worst = max(found, key=lambda item: item[1].value or 0.0)
            if worst.value is None:
                extent = f"{worst_name}: {worst}"
            else:
                extent = f"up to {round(worst.value, 2):g} {worst.unit}".rstrip()
            count = len({name for name, _ in found})
            hint = f": {worst.hint}" if worst.hint else ""
            lines.append(f"{count} of {total} drives {kind} ({extent}){hint}")
        return lines

    def details(self) -> list[str]:
        """A line on each rejected trajectory, with all its reasons."""
        return [
            f"{name}: {'; '.join(map(str, reasons))}" for name, reasons in self.rejected.items()
        ]

    def __str__(self) -> str:
        """How many were accepted, and a line on each kind of reason and on each note."""
        total = len(self.accepted) + len(self.rejected)
        lines = [f"{len(self.accepted)} of {total} drives accepted"]
        return "\n  ".join([*lines, *self.summary(), *self.notes])


class NoDriveAcceptedError(ValueError):
    """Every trajectory of a file is rejected.

    Args:
        path: the file.
        report: why.
    """

    def __init__(self, path: str | Path, report: ImportReport) -> None:
        self.report = report
        lines = [*report.summary(), *report.notes]
        super().__init__("\n  ".join([f"{path}: no drive is accepted: {lines[0]}", *lines[1:]]))
