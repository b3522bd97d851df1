"""Read recorded trajectories from CSV files, NumPy files or ROS bags."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from ..places import no_file, no_folder
from .bag_file import BagFile, bags
from .bag_topics import BagTopics
from .csv_file import CsvFile
from .npz_file import NpzFile
from .recordings import Recording


def silent(iterable: Iterable[Any], **_: Any) -> Iterable[Any]:
    """Shows no progress."""
    return iterable


def open_recordings(
    path: str | Path,
    boxes: str | Path | None = None,
    *,
    topics: BagTopics | None = None,
    gap: float = 0.5,
    goal_radius: float = 0.3,
    progress: Callable[..., Iterable[Any]] = silent,
) -> CsvFile | NpzFile | BagFile:
    """Open a file of trajectories; capital suffixes count as well.

    Args:
        path: a ``.csv`` or ``.npz`` file, a ROS bag (``.mcap``, ``.bag``, or a folder with
            ``metadata.yaml``), or a folder of bags.
        boxes: a ``.csv`` file with the boxes around the trajectories of a ``.csv`` file or a bag.

    Keyword Args:
        topics: of a bag.
        gap: of a bag: longest time without word of the human, seconds.
        goal_radius: of a bag: within which a drive is at its goal and ends, metres.
        progress: of reading a bag, see :func:`envs.demonstrations.import_demonstrations`.

    Returns:
        Iterates over its trajectories and has a length; ``notes`` says what was passed over.

    Raises:
        FileNotFoundError: if a file does not exist.
        ImportError: for a bag, without ``rosbags``.
        ValueError: if a file is not of its format; the message names the file, and the line and
            column, the array or the topic.
    """
    path = Path(path)
    there = not no_file(path) or not no_folder(path)
    found = bags(path) if there else []
    for one in found:
        if (what := no_file(one)) and no_folder(one):
            raise FileNotFoundError(f"{one} {what}.")
    for file in (None if found else path, boxes):
        if file is not None and (what := no_file(file)):
            raise FileNotFoundError(f"{file} {what}{_instead(Path(file))}.")
    boxes = None if boxes is None else Path(boxes)
    if found:
        return BagFile(
            path, boxes, topics=topics, gap=gap, goal_radius=goal_radius, progress=progress
        )
    if topics is not None:
        raise ValueError(f"{path} is no bag: it has no topics to choose.")
    suffix = path.suffix.lower()
    if suffix == ".csv":
        return CsvFile(path, boxes)
    if suffix == ".npz":
        if boxes is not None:
            raise ValueError(f"{path}: the boxes of an .npz file are its array 'boxes'.")
        return NpzFile(path)
    raise ValueError(
        f"{path}: trajectories are a .csv or an .npz file or a ROS bag, got {path.suffix!r}."
    )


def _instead(path: Path) -> str:
    """What in a folder is meant, where a file is needed."""
    if not path.is_dir():
        return ""
    inside = sorted(one for one in path.iterdir() if one.suffix.lower() in (".csv", ".npz"))
    return f": is {inside[0]} meant?" if inside else ", and holds no .csv, .npz or ROS bag"


def read_recordings(path: str | Path, boxes: str | Path | None = None) -> list[Recording]:
    """Read the trajectories of a ``.csv`` or ``.npz`` file.

    What is wrong with a trajectory, such as a cell that is empty, stands in its ``faults``; numbers
    that make no sense, such as NaN, are left to :func:`envs.demonstrations.feasibility.check`.

    Args:
        path: the file.
        boxes: a second ``.csv`` file with the boxes of a ``.csv`` file's trajectories.

    Returns:
        The trajectories, in the order in which their last lines come.

    Raises:
        FileNotFoundError: if a file does not exist.
        ValueError: if a file is not of its format; the message names the file, and the line and
            column or the array.

    Examples:
        >>> import tempfile
        >>> from pathlib import Path
        >>> text = '''trajectory,time,x,y,human_x,human_y,goal_x,goal_y
        ... first,0.0,0.0,0.0,3.0,2.0,6.0,0.0
        ... first,0.2,0.1,0.0,3.0,2.0,6.0,0.0
        ... second,0.0,0.0,N/A,3.0,2.0,6.0,0.0
        ... '''
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = Path(folder) / "drives.csv"
        ...     _ = file.write_text(text)
        ...     first, second = read_recordings(file)
        >>> first.name, first.position.tolist(), first.heading
        ('first', [[0.0, 0.0], [0.1, 0.0]], None)
        >>> second.faults
        ("line 4, column y: 'N/A' is not a number",)
    """
    return list(open_recordings(path, boxes))
