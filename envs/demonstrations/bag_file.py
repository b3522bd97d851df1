"""Recorded drives in ROS bags: topics that nobody synchronised, cut into drives to one goal each."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from .bag_topics import BagTopics, Track, read_tracks
from .boxes import BoxFile
from .recordings import Recording, make_recording
from .report import enough

_SUFFIXES = (".mcap", ".db3", ".bag")
_SAME_GOAL = 0.05
"""Metres by which a goal must differ from the last one to be another one."""
_STANDS = 3.0
"""Seconds of standing that separate two drives where there are no goals."""
_STILL = (0.02, 0.05)
"""Metres and radians within which a robot stands."""
_FASTEST_HUMAN = 3.0
"""m/s; what is faster between two messages are two people."""


def bags(path: Path) -> list[Path]:
    """The bags at a path: itself, or those in a folder; empty if there are none."""
    if _is_bag(path):
        # A ROS 2 bag of sqlite3 is its folder: the file alone has no list of its topics.
        alone = path.suffix.lower() == ".db3" and (path.parent / "metadata.yaml").is_file()
        return [path.parent if alone else path]
    return sorted(filter(_is_bag, path.iterdir())) if path.is_dir() else []


def _is_bag(path: Path) -> bool:
    return path.suffix.lower() in _SUFFIXES or (path / "metadata.yaml").is_file()


class BagFile:
    """The drives of a bag, or of all bags in a folder. It is read at once: poses need little memory.

    A drive is named after its bag, with a number where there are several. Points are those of the
    robot's topic; the human is interpolated between the messages of its own.

    Args:
        path: the bag or the folder.
        boxes: a ``.csv`` file with boxes around the drives.
        topics: which ones are read.
        gap: longest time without word of the human, seconds.
        goal_radius: within which the goal is reached, metres: there a drive ends.
        progress: see :func:`envs.demonstrations.import_demonstrations`.

    Raises:
        ImportError: without ``rosbags``.
        ValueError: if a bag cannot be read, or its topics do not fit together.
    """

    def __init__(
        self,
        path: Path,
        boxes: Path | None = None,
        *,
        topics: BagTopics | None = None,
        gap: float = 0.5,
        goal_radius: float = 0.3,
        progress: Callable[..., Iterable[Any]],
    ) -> None:
        self._gap, self._radius, self.notes = gap, goal_radius, []
        topics = topics or BagTopics()
        self._drives: dict[str, tuple[Track, Track, np.ndarray]] = {}
        for bag in bags(path):
            tracks = read_tracks(bag, topics, progress)
            drives = list(self._cut(bag, tracks))
            for number, drive in enumerate(drives, 1):
                name = bag.stem if len(drives) == 1 else f"{bag.stem} {number}"
                self._drives[name] = drive
        if not self._drives:
            raise ValueError(f"{path} holds no drive: no pose of the robot comes after a goal.")
        self._boxes = BoxFile(boxes, path, self._drives)

    def __len__(self) -> int:
        return len(self._drives)

    def __iter__(self) -> Iterator[Recording]:
        for name, (robot, human, goal) in self._drives.items():
            position = np.concatenate([points[:1] for points in robot.points])
            seen, fault = _human_at(robot, human, self._gap)
            values = {
                "time": robot.time,
                **dict(zip(("x", "y", "heading"), position.T)),
                **dict(zip(("human_x", "human_y"), seen.T)),
                "goal_x": np.full(len(robot.time), goal[0]),
                "goal_y": np.full(len(robot.time), goal[1]),
            }
            yield make_recording(
                name,
                values,
                self._boxes.around(name),
                where="point",
                rows=np.arange(len(robot.time)),
                faults=[*([fault] if fault else []), *self._boxes.faults(name)],
            )

    def _cut(
        self, bag: Path, tracks: dict[str, Track]
    ) -> Iterator[tuple[Track, Track, np.ndarray]]:
        """Robot, human and goal of each drive."""
        robot = self._in_order(bag, tracks["robot"])
        human = _nearest(_fixed(bag, tracks["human"], robot, "human"), robot)
        if "goal" in tracks:
            goals = _fixed(bag, tracks["goal"], robot, "goal")
            starts, places = _new_goals(goals)
            before = int(np.searchsorted(robot.time, starts[0]))
            if before:
                self.notes.append(f"left out {before} point(s) of {bag.name} before its first goal")
            ends = [*starts[1:], math.inf]
            spans = [np.searchsorted(robot.time, pair) for pair in zip(starts, ends)]
            parts = [
                (slice(*span), place) for span, place in zip(spans, places) if span[0] < span[1]
            ]
        else:
            parts = [(span, robot.points[span.stop - 1][0, :2]) for span in _between_stands(robot)]
        for span, place in parts:
            drive = Track(robot.time[span], robot.points[span], robot.frame)
            # Until it sets off nobody drives.
            waits = _standing(drive, 0)
            # What comes after the arrival is none of the drive, and may have gaps.
            arrives = _arrival(drive, place, self._radius)
            moves = Track(drive.time[waits:arrives], drive.points[waits:arrives], drive.frame)
            yield moves, human, place

    def _in_order(self, bag: Path, robot: Track) -> Track:
        """Without points of one time, which messages that are sent twice have."""
        new = np.append(True, np.diff(robot.time) > 0)
        if not new.all():
            self.notes.append(f"left out {int((~new).sum())} point(s) of {bag.name} of equal time")
        points = [point for point, kept in zip(robot.points, new) if kept]
        return Track(robot.time[new], points, robot.frame, robot.child)


def _fixed(bag: Path, track: Track, robot: Track, what: str) -> Track:
    """In the frame of the robot's poses; what is told from the robot is turned into it."""
    if track.frame == robot.frame:
        return track
    if track.frame != (robot.child or "base_link"):
        raise ValueError(
            f"{bag}: the {what} is told in frame {track.frame!r}, the robot in {robot.frame!r}: "
            f"record both in one frame, or choose another --robot-topic or --{what}-topic."
        )
    points = []
    for index, seen in zip(_closest(robot.time, track.time), track.points):
        at = robot.points[index][0]
        cos, sin = math.cos(at[2]), math.sin(at[2])
        turned = seen.copy()
        turned[:, 0] = at[0] + cos * seen[:, 0] - sin * seen[:, 1]
        turned[:, 1] = at[1] + sin * seen[:, 0] + cos * seen[:, 1]
        points.append(turned)
    return Track(track.time, points, robot.frame)


def _closest(times: np.ndarray, asked: np.ndarray) -> np.ndarray:
    """Index of the time that is closest to each that is asked for; times rise."""
    return np.searchsorted((times[1:] + times[:-1]) / 2, asked)


def _nearest(human: Track, robot: Track) -> Track:
    """Of the people in each message the one nearest to the robot; without messages of nobody."""
    told = np.array([len(points) > 0 for points in human.points], dtype=bool)
    people = [points for points in human.points if len(points)]
    points = []
    for index, seen in zip(_closest(robot.time, human.time[told]), people):
        away = np.hypot(*(seen[:, :2] - robot.points[index][0, :2]).T)
        points.append(seen[int(away.argmin())][None])
    return Track(human.time[told], points, human.frame)


def _new_goals(goals: Track) -> tuple[list[float], list[np.ndarray]]:
    """When another goal came, and where it is; senders repeat themselves."""
    starts, places = [], []
    for time, points in zip(goals.time, goals.points):
        place = points[0, :2]
        # Not finite: kept, and refused with its drive.
        if not places or not np.hypot(*(place - places[-1])) <= _SAME_GOAL:
            starts.append(float(time))
            places.append(place)
    return starts, places


def _arrival(robot: Track, goal: np.ndarray, radius: float) -> int | None:
    """How many points there are up to the first one at the goal; ``None`` if there is none."""
    away = np.hypot(*(np.concatenate([one[:1, :2] for one in robot.points]) - goal).T)
    at = np.flatnonzero(away <= radius)
    return int(at[0]) + 1 if len(at) else None


def _standing(robot: Track, begin: int) -> int:
    """Index of the last point at which the robot has not left that of ``begin``."""
    first = robot.points[begin][0]
    for index in range(begin, len(robot.points)):
        x, y, yaw = robot.points[index][0] - first
        turned = abs(math.remainder(yaw, 2 * math.pi)) if math.isfinite(yaw) else math.inf
        if not (math.hypot(x, y) <= _STILL[0] and turned <= _STILL[1]):
            return max(begin, index - 1)
    return len(robot.points) - 1


def _between_stands(robot: Track) -> list[slice]:
    """What the robot drove between two stands, or where its topic was silent for as long."""
    spans, begin, index, last = [], None, 0, len(robot.time) - 1
    while index < last:
        until = _standing(robot, index)
        stands = robot.time[until] - robot.time[index] >= _STANDS or until == last
        silent = robot.time[index + 1] - robot.time[index] >= _STANDS
        if stands or silent:
            if begin is not None and index > begin:
                spans.append(slice(begin, index + 1))
            begin = None if stands else index + 1
        elif begin is None:
            begin = index
        index = max(until, index + 1) if stands else index + 1
    if begin is not None and last > begin:
        spans.append(slice(begin, last + 1))
    return spans


def _human_at(robot: Track, human: Track, gap: float) -> tuple[np.ndarray, str | None]:
    """Where the human was at each point of the robot ``[T, 2]``, and what is not known."""
    if not len(human.time):
        return np.full((len(robot.time), 2), np.nan), "no message tells of a human"
    time, places = human.time, np.concatenate(human.points)[:, :2]
    after = np.searchsorted(time, robot.time).clip(0, len(time) - 1)
    before = (after - 1).clip(0)
    before[robot.time >= time[-1]] = len(time) - 1
    # Before the first word and after the last one there is one side alone.
    after[robot.time <= time[0]] = 0
    late = np.maximum(robot.time - time[before], 0.0), np.maximum(time[after] - robot.time, 0.0)
    outside = (robot.time < time[0]) | (robot.time > time[-1])
    between = np.where(late[1] > 0, sum(late), 0.0)
    wait = np.where(outside, np.abs(robot.time - time[before]), between)
    span = time[after] - time[before]
    share = np.divide(late[0], span, out=np.zeros_like(span), where=span > 0)
    step = places[after] - places[before]
    # Two people are no one in between.
    jump = np.hypot(*step.T) > _FASTEST_HUMAN * span + 0.1
    share = np.where(jump, share.round(), share)
    seen = places[before] + share[:, None] * step
    worst = int(wait.argmax())
    if wait[worst] > gap + 1e-9:
        return seen, (
            f"no word of the human for {wait[worst]:.2f} s around {robot.time[worst]:.2f} s "
            f"(point {worst}), at most {gap:g} s are bridged: --gap-tolerance {enough(wait[worst])}"
        )
    return seen, None
