"""Recorded trajectories as they stand in their file; ``docs/demonstrations.md`` has the formats."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

COLUMNS = ("time", "x", "y", "human_x", "human_y", "goal_x", "goal_y")
"""Numbers that every point of a trajectory has: seconds and metres."""

LONGEST_NAME = 200
"""Characters of what a trajectory is called."""

BOX_COLUMNS = ("x", "y", "yaw", "half_length", "half_width")
"""A rectangle on the floor: metres, and radians for its yaw."""


@dataclasses.dataclass(frozen=True)
class Recording:
    """One recorded trajectory of ``T`` points, as it stands in its file (float64).

    Args:
        name: what reports call it.
        time: seconds, ``[T]``.
        position: of the robot, metres, ``[T, 2]``.
        heading: of the robot, radians, ``[T]``; ``None`` where the file has none.
        human: position of the human, metres, ``[T, 2]``.
        goal: metres, ``[T, 2]``.
        boxes: x, y, yaw, half length, half width, ``[M, 5]``.
        rows: where in the file each point stands, ``[T]``.
        where: what ``rows`` count: "line" or "point".
        faults: what could not be read, with its place; such a trajectory is of no use.
        repeated: points that repeated the one before in every number, and are left out.
    """

    name: str
    time: np.ndarray
    position: np.ndarray
    heading: np.ndarray | None
    human: np.ndarray
    goal: np.ndarray
    boxes: np.ndarray
    rows: np.ndarray
    where: str = "point"
    faults: tuple[str, ...] = ()
    repeated: int = 0

    def columns(self) -> dict[str, np.ndarray]:
        """The numbers ``[T]`` of every column, by its name in the file."""
        pairs = (self.position.T, self.human.T, self.goal.T)
        values = dict(zip(COLUMNS, (self.time, *(row for pair in pairs for row in pair))))
        return values if self.heading is None else {**values, "heading": self.heading}

    def place(self, index: int) -> str:
        """Where in the file a point stands, such as "line 12"."""
        return f"{self.where} {self.rows[index]}"


def make_recording(
    name: str,
    values: dict[str, np.ndarray],
    boxes: np.ndarray,
    *,
    where: str,
    rows: np.ndarray,
    faults: Sequence[str] = (),
) -> Recording:
    """A recording from its columns ``[T]``, without the points that repeat the one before."""
    stacked = np.stack(list(values.values()))
    again = stacked[:, 1:] == stacked[:, :-1]
    again |= np.isnan(stacked[:, 1:]) & np.isnan(stacked[:, :-1])
    new = np.append(np.ones(min(1, len(rows)), dtype=bool), ~again.all(0))
    kept = dict(zip(values, stacked[:, new]))
    # No heading at all is to be derived; some without the others is an error of the recording.
    heading = kept.get("heading")
    if heading is not None and np.isnan(heading).all():
        heading = None

    def pair(prefix: str) -> np.ndarray:
        return np.stack((kept[f"{prefix}x"], kept[f"{prefix}y"]), axis=-1)

    return Recording(
        name,
        kept["time"],
        pair(""),
        heading,
        pair("human_"),
        pair("goal_"),
        boxes,
        rows[new],
        where,
        tuple(faults),
        int((~new).sum()),
    )


def box_fault(box: Sequence[float], place: str) -> str | None:
    """What is wrong with a box, or ``None``.

    Raises:
        ValueError: for a yaw beyond a full turn. The unit is that of the whole file: 90 in one line
            makes the 5 in another one wrong, too, which nobody could see.
    """
    x, y, yaw, half_length, half_width = map(float, box)
    if math.isfinite(yaw) and abs(yaw) > 2 * math.pi + 1e-6:
        raise ValueError(
            f"{place}, column yaw: {yaw:g} in yaw: degrees? Radians from -2 pi to 2 pi are expected."
        )
    if all(map(math.isfinite, (x, y, yaw, half_length, half_width))) and (
        min(half_length, half_width) > 0
    ):
        return None
    return (
        f"{place}: a box needs finite {', '.join(BOX_COLUMNS)} with positive half sizes, got "
        f"{[x, y, yaw, half_length, half_width]}"
    )
