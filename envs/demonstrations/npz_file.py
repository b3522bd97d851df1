"""Recorded trajectories in a NumPy file."""

from __future__ import annotations

import zipfile
import zlib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ..fields import shown
from .recordings import COLUMNS, LONGEST_NAME, Recording, box_fault, make_recording

_OPTIONAL = ("heading", "boxes", "trajectory")
_BROADCAST = ("human_x", "human_y", "goal_x", "goal_y")


class NpzFile:
    """The trajectories of an ``.npz`` file, in its order.

    Args:
        path: the file.

    Raises:
        ValueError: if it is not of this format; the message names the file and the array.
    """

    def __init__(self, path: Path) -> None:
        arrays = _load_arrays(path)
        shape = arrays["time"].shape
        if len(shape) != 2 or not shape[0]:
            hint = ": a single trajectory is time[None]" if len(shape) == 1 else ""
            raise ValueError(f"{path}, array time: expected shape [N, T], got {list(shape)}{hint}.")
        boxes = arrays.pop("boxes", np.zeros((shape[0], 0, 5)))
        if boxes.ndim != 3:
            raise ValueError(
                f"{path}, array boxes: expected shape [N, M, 5], got {list(boxes.shape)}."
            )
        self._path = path
        self._boxes = _shaped(path, "boxes", boxes, (shape[0], boxes.shape[1], 5))
        self._names = _names(path, arrays.pop("trajectory", np.arange(shape[0])), shape[0])
        self._values = {name: _shaped(path, name, array, shape) for name, array in arrays.items()}
        self.notes: list[str] = []

    def __len__(self) -> int:
        return len(self._names)

    def __iter__(self) -> Iterator[Recording]:
        for row, name in enumerate(self._names):
            values = {key: array[row].astype(np.float64) for key, array in self._values.items()}
            # Padding is where the robot's own columns are all NaN, up to the end.
            used = ~np.isnan(np.stack([values[key] for key in ("time", "x", "y")])).all(0)
            length = int(used.nonzero()[0].max(initial=-1)) + 1
            boxes = self._boxes[row].astype(np.float64)
            boxes = boxes[~np.isnan(boxes).all(-1)]
            faults = (
                box_fault(box, f"{self._path}, array boxes, trajectory {name!r}") for box in boxes
            )
            yield make_recording(
                name,
                {key: array[:length] for key, array in values.items()},
                boxes,
                where="point",
                rows=np.arange(length),
                faults=[fault for fault in faults if fault],
            )


def _load_arrays(path: Path) -> dict[str, np.ndarray]:
    if path.is_file() and not path.stat().st_size:
        raise ValueError(f"{path} is empty: it must hold the arrays {', '.join(COLUMNS)}.")
    try:
        file = np.load(path, allow_pickle=False)
        if not isinstance(file, np.lib.npyio.NpzFile):
            raise ValueError("it holds a single array")
        with file:
            unknown = [name for name in file.files if name not in (*COLUMNS, *_OPTIONAL)]
            missing = [name for name in COLUMNS if name not in file.files]
            arrays = {name: file[name] for name in file.files if not (unknown or missing)}
    # What is no archive at all is taken for a pickle, which is refused: a ValueError too.
    except (
        ValueError,
        OSError,
        EOFError,
        MemoryError,  # a header that promises more than any machine has
        RuntimeError,  # an encrypted archive, and NotImplementedError: an unknown compression
        zipfile.BadZipFile,
        zlib.error,
    ) as error:
        raise ValueError(f"{path} is not an .npz file of plain arrays: {error}.") from error
    if missing or unknown:
        raise ValueError(
            f"{path} must hold the arrays {', '.join(COLUMNS)} and may hold "
            f"{', '.join(_OPTIONAL)}; missing: {missing}, unknown: {unknown}."
        )
    return arrays


def _names(path: Path, array: np.ndarray, count: int) -> list[str]:
    names = [
        name.decode(errors="replace") if isinstance(name, bytes) else str(name)
        for name in array.ravel().tolist()
    ]
    if wrong := [name for name in names if not name.isprintable() or len(name) > LONGEST_NAME]:
        raise ValueError(
            f"{path}, array trajectory: {shown(wrong[0])} is no name of up to {LONGEST_NAME} characters."
        )
    twice = [name for name, times in Counter(names).items() if times > 1]
    if array.shape != (count,) or twice:
        what = f"; twice: {twice[:5]}" if twice else f", got shape {list(array.shape)}"
        raise ValueError(f"{path}, array trajectory: expected {count} different names{what}.")
    return names


def _shaped(path: Path, name: str, array: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """The array in this shape, of its own type: rows are converted one at a time."""
    if not np.issubdtype(array.dtype, np.number) or np.iscomplexobj(array):
        raise ValueError(f"{path}, array {name}: expected real numbers, got {array.dtype}.")
    if name in _BROADCAST and array.shape == shape[:1]:
        array = np.broadcast_to(array[:, None], shape)
    if array.shape != shape:
        also = f" or {list(shape[:1])}" if name in _BROADCAST else ""
        raise ValueError(
            f"{path}, array {name}: expected shape {list(shape)}{also}, got {list(array.shape)}."
        )
    return array
