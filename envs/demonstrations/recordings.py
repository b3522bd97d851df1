"""Read recorded trajectories from CSV or NumPy files; ``docs/demonstrations.md`` has the format."""

from __future__ import annotations

import csv
import dataclasses
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

COLUMNS = ("time", "x", "y", "human_x", "human_y", "goal_x", "goal_y")
"""Numbers that every point of a trajectory has: seconds and metres."""

BOX_COLUMNS = ("x", "y", "yaw", "half_length", "half_width")
"""A rectangle on the floor: metres, and radians for its yaw."""

_BROADCAST = ("human_x", "human_y", "goal_x", "goal_y")


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
        places: where in the file each point stands, such as "line 12".
    """

    name: str
    time: np.ndarray
    position: np.ndarray
    heading: np.ndarray | None
    human: np.ndarray
    goal: np.ndarray
    boxes: np.ndarray
    places: tuple[str, ...]

    def columns(self) -> dict[str, np.ndarray]:
        """The numbers ``[T]`` of every column, by its name in the file."""
        pairs = (self.position.T, self.human.T, self.goal.T)
        values = dict(zip(COLUMNS, (self.time, *(row for pair in pairs for row in pair))))
        return values if self.heading is None else {**values, "heading": self.heading}


def read_recordings(path: str | Path, boxes: str | Path | None = None) -> list[Recording]:
    """Read the trajectories of a ``.csv`` or ``.npz`` file.

    Args:
        path: the file.
        boxes: a second ``.csv`` file with the boxes of a ``.csv`` file's trajectories.

    Returns:
        The trajectories, in the order in which the file first names them.

    Raises:
        FileNotFoundError: if a file does not exist.
        ValueError: if a file is not of this format; the message names the file, and the line and
            column or the array. Numbers that parse but make no sense, such as NaN, are left to
            :func:`envs.demonstrations.feasibility.check`.

    Examples:
        >>> import tempfile
        >>> from pathlib import Path
        >>> text = '''trajectory,time,x,y,human_x,human_y,goal_x,goal_y
        ... first,0.0,0.0,0.0,3.0,2.0,6.0,0.0
        ... first,0.2,0.1,0.0,3.0,2.0,6.0,0.0
        ... '''
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = Path(folder) / "drives.csv"
        ...     _ = file.write_text(text)
        ...     recording = read_recordings(file)[0]
        >>> recording.name, recording.position.tolist(), recording.heading
        ('first', [[0.0, 0.0], [0.1, 0.0]], None)
    """
    path = Path(path)
    for file in (path, boxes):
        if file is not None and not Path(file).is_file():
            raise FileNotFoundError(f"{file} not found.")
    if path.suffix == ".csv":
        return _read_csv(path, None if boxes is None else Path(boxes))
    if path.suffix == ".npz":
        if boxes is not None:
            raise ValueError(f"{path}: the boxes of an .npz file are its array 'boxes'.")
        return _read_npz(path)
    raise ValueError(f"{path}: trajectories are a .csv or an .npz file, got {path.suffix!r}.")


def _recording(
    name: str, values: dict[str, np.ndarray], boxes: np.ndarray, places: Sequence[str]
) -> Recording:
    heading = values.get("heading")
    # No heading at all is to be derived; some without the others is an error of the recording.
    if heading is not None and np.isnan(heading).all():
        heading = None

    def pair(prefix: str) -> np.ndarray:
        return np.stack((values[f"{prefix}x"], values[f"{prefix}y"]), axis=-1)

    return Recording(
        name,
        values["time"],
        pair(""),
        heading,
        pair("human_"),
        pair("goal_"),
        boxes,
        tuple(places),
    )


# --- CSV -----------------------------------------------------------------------------------------


def _rows(path: Path, required: Sequence[str], optional: Sequence[str] = ()) -> Iterator:
    """Yield (line, trajectory, numbers) of a CSV file with a header; empty optional cells are NaN."""
    # Spreadsheet programs put a byte order mark in front of the header.
    with path.open(newline="", encoding="utf-8-sig") as file:
        reader = csv.reader(file)
        try:
            header = [name.strip() for name in next(reader, [])]
            expected = ["trajectory", *required]
            missing = [name for name in expected if name not in header]
            unknown = [name for name in header if name not in (*expected, *optional)]
            if missing or unknown or len(set(header)) < len(header):
                raise ValueError(
                    f"{path}, line 1: the header must name the columns {','.join(expected)}"
                    f"{''.join(f' and may name {name}' for name in optional)}, each once; "
                    f"missing: {missing}, unknown: {unknown}."
                )
            for row in reader:
                if row:
                    yield _parse_row(path, reader.line_num, header, row, optional)
        except (csv.Error, UnicodeDecodeError) as error:
            raise ValueError(f"{path} is not a CSV file in UTF-8: {error}.") from error


def _parse_row(
    path: Path, line: int, header: list[str], row: list[str], optional: Sequence[str]
) -> tuple[int, str, dict[str, float]]:
    if len(row) != len(header):
        raise ValueError(f"{path}, line {line}: {len(row)} cells, but {len(header)} columns.")
    cells = dict(zip(header, (cell.strip() for cell in row)))
    name = cells.pop("trajectory")
    if not name:
        raise ValueError(f"{path}, line {line}, column trajectory: the cell is empty.")
    numbers = {}
    for column, cell in cells.items():
        try:
            numbers[column] = float("nan" if column in optional and not cell else cell)
        except ValueError:
            raise ValueError(
                f"{path}, line {line}, column {column}: {cell!r} is not a number."
            ) from None
    return line, name, numbers


def _read_csv(path: Path, boxes: Path | None) -> list[Recording]:
    points: dict[str, list[tuple[int, dict[str, float]]]] = {}
    for line, name, numbers in _rows(path, COLUMNS, ("heading",)):
        points.setdefault(name, []).append((line, numbers))
    if not points:
        raise ValueError(f"{path} holds no trajectory: there is nothing below the header.")
    surroundings: dict[str, list[list[float]]] = {name: [] for name in points}
    for line, name, numbers in _rows(boxes, BOX_COLUMNS) if boxes else ():
        if name not in points:
            raise ValueError(f"{boxes}, line {line}: {path} has no trajectory {name!r}.")
        box = [numbers[column] for column in BOX_COLUMNS]
        _check_box(box, f"{boxes}, line {line}")
        surroundings[name].append(box)
    return [
        _recording(
            name,
            {column: np.array([numbers[column] for _, numbers in rows]) for column in rows[0][1]},
            np.array(surroundings[name], dtype=np.float64).reshape(-1, 5),
            [f"line {line}" for line, _ in rows],
        )
        for name, rows in points.items()
    ]


def _check_box(box: Sequence[float], place: str) -> None:
    if not np.isfinite(box).all() or min(box[3:]) <= 0:
        raise ValueError(
            f"{place}: a box needs finite {', '.join(BOX_COLUMNS)} with positive half sizes, got "
            f"{[float(value) for value in box]}."
        )


# --- NumPy ---------------------------------------------------------------------------------------


def _load_arrays(path: Path) -> dict[str, np.ndarray]:
    optional = ("heading", "boxes", "trajectory")
    try:
        file = np.load(path, allow_pickle=False)
        if not isinstance(file, np.lib.npyio.NpzFile):
            raise ValueError("it holds a single array")
        with file:
            arrays = {name: file[name] for name in file.files}
    # What is no archive at all is taken for a pickle, which is refused: a ValueError too.
    except (ValueError, OSError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path} is not an .npz file of plain arrays: {error}.") from error
    missing = [name for name in COLUMNS if name not in arrays]
    unknown = [name for name in arrays if name not in (*COLUMNS, *optional)]
    if missing or unknown:
        raise ValueError(
            f"{path} must hold the arrays {', '.join(COLUMNS)} and may hold "
            f"{', '.join(optional)}; missing: {missing}, unknown: {unknown}."
        )
    return arrays


def _shaped(path: Path, name: str, array: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    if not np.issubdtype(array.dtype, np.number) or np.iscomplexobj(array):
        raise ValueError(f"{path}, array {name}: expected real numbers, got {array.dtype}.")
    if name in _BROADCAST and array.shape == shape[:1]:
        array = np.broadcast_to(array[:, None], shape)
    if array.shape != shape:
        also = f" or {list(shape[:1])}" if name in _BROADCAST else ""
        raise ValueError(
            f"{path}, array {name}: expected shape {list(shape)}{also}, got {list(array.shape)}."
        )
    return array.astype(np.float64)


def _read_npz(path: Path) -> list[Recording]:
    arrays = _load_arrays(path)
    shape = arrays["time"].shape
    if len(shape) != 2 or not shape[0]:
        raise ValueError(f"{path}, array time: expected shape [N, T], got {list(shape)}.")
    count = shape[0]
    boxes = arrays.pop("boxes", np.zeros((count, 0, 5)))
    if boxes.ndim != 3:
        raise ValueError(f"{path}, array boxes: expected shape [N, M, 5], got {list(boxes.shape)}.")
    boxes = _shaped(path, "boxes", boxes, (count, boxes.shape[1], 5))
    names = arrays.pop("trajectory", np.arange(count)).astype(str)
    if names.shape != (count,) or len(set(names.tolist())) < count:
        raise ValueError(f"{path}, array trajectory: expected {count} different names.")
    values = {name: _shaped(path, name, array, shape) for name, array in arrays.items()}
    recordings = []
    for row, name in enumerate(names.tolist()):
        # Padding is where the robot's own columns are all NaN, up to the end.
        used = ~np.isnan(np.stack([values[key][row] for key in ("time", "x", "y")])).all(0)
        length = int(used.nonzero()[0].max(initial=-1)) + 1
        present = boxes[row][~np.isnan(boxes[row]).all(-1)]
        for box in present:
            _check_box(box, f"{path}, array boxes, trajectory {name!r}")
        points = {key: array[row, :length] for key, array in values.items()}
        recordings.append(
            _recording(name, points, present, [f"point {index}" for index in range(length)])
        )
    return recordings
