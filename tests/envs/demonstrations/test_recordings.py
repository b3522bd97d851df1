"""Reading recorded trajectories: what is read, and an error that names file, line and column."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from envs.demonstrations.recordings import COLUMNS, read_recordings

HEADER = "trajectory,time,x,y,heading,human_x,human_y,goal_x,goal_y"
TEXT = f"""{HEADER}
a,0.0,1,2,0.5,3,4,5,6
b,0.0,9,9,,3,4,5,6
a,0.2,1.1,2.1,0.6,3.5,4.5,5,6

b,0.3,9.1,9,,3,4,5,6
"""
BOXES = "trajectory,x,y,yaw,half_length,half_width\na,1,2,0.3,0.4,0.5\na,3,2,0.1,0.2,0.2\n"


@pytest.fixture
def write(tmp_path):
    def write(text: str, name: str = "drives.csv") -> Path:
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        return path

    return write


def test_csv(write):
    first, second = read_recordings(write(TEXT), write(BOXES, "boxes.csv"))
    assert (first.name, second.name) == ("a", "b")
    assert first.time.tolist() == [0.0, 0.2]
    assert first.position.tolist() == [[1.0, 2.0], [1.1, 2.1]]
    assert first.heading.tolist() == [0.5, 0.6]
    assert first.human.tolist() == [[3.0, 4.0], [3.5, 4.5]]
    assert first.goal.tolist() == [[5.0, 6.0]] * 2
    assert first.boxes.tolist() == [[1.0, 2.0, 0.3, 0.4, 0.5], [3.0, 2.0, 0.1, 0.2, 0.2]]
    assert first.places == ("line 2", "line 4")
    assert second.heading is None
    assert second.boxes.shape == (0, 5)
    assert second.places == ("line 3", "line 6")


def test_columns_come_in_any_order_and_a_byte_order_mark_is_skipped(write):
    rows = [row.split(",")[::-1] for row in TEXT.split("\n") if row]
    text = "\ufeff" + "\n".join(" , ".join(row) for row in rows)
    mirrored, straight = read_recordings(write(text, "r.csv")), read_recordings(write(TEXT))
    assert [one.name for one in mirrored] == ["a", "b"]
    for one, other in zip(mirrored, straight):
        assert one.name == other.name
        for name, values in one.columns().items():
            assert np.array_equal(values, other.columns()[name])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("1.1,", "one,", "line 4, column x: 'one' is not a number"),
        ("1.1,", ",", "line 4, column x: '' is not a number"),
        ("0.6,", "?,", "line 4, column heading: '?' is not a number"),
        ("a,0.2", ",0.2", "line 4, column trajectory: the cell is empty"),
        ("a,0.2,", "a,0.2,7,", "line 4: 10 cells, but 9 columns"),
        ("goal_x,", "", "line 1: the header must name .*missing: ['goal_x'], unknown: []"),
        ("heading", "headng", "line 1: .*may name heading.*unknown: ['headng']"),
        ("heading", "y", "line 1: the header must name .*each once"),
        (TEXT, HEADER, "holds no trajectory"),
        (TEXT, "", "line 1: the header must name"),
    ],
)
def test_csv_errors(write, old, new, message):
    assert old in TEXT
    path = write(TEXT.replace(old, new, 1))
    pattern = re.escape(message).replace(r"\.\*", ".*")
    with pytest.raises(ValueError, match=rf"drives\.csv.*{pattern}"):
        read_recordings(path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("a,3", "c,3", r"boxes\.csv, line 3: .*drives\.csv has no trajectory 'c'"),
        ("0.2,0.2", "0.2,0", r"boxes\.csv, line 3: a box needs .* positive half sizes"),
        ("a,3", "a,nan", r"boxes\.csv, line 3: a box needs finite"),
        ("a,3", "a,", r"boxes\.csv, line 3, column x: '' is not a number"),
        ("yaw", "angle", r"boxes\.csv, line 1: .*missing: \['yaw'\], unknown: \['angle'\]"),
    ],
)
def test_box_errors(write, old, new, message):
    with pytest.raises(ValueError, match=message):
        read_recordings(write(TEXT), write(BOXES.replace(old, new), "boxes.csv"))


def test_numbers_without_sense_are_read(write):
    # They reject one trajectory, not the file: see the feasibility check.
    first, _ = read_recordings(write(TEXT.replace("1.1,", "nan,").replace("3.5", "inf")))
    assert np.isnan(first.position[1, 0])
    assert np.isinf(first.human[1, 0])


def test_a_csv_file_that_is_no_text(tmp_path):
    path = tmp_path / "drives.csv"
    path.write_bytes(b"\xff\xfe\x00\x01" * 50)
    with pytest.raises(ValueError, match=r"drives\.csv is not a CSV file in UTF-8"):
        read_recordings(path)


def test_missing_files_and_other_types(write, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.csv not found"):
        read_recordings(tmp_path / "none.csv")
    with pytest.raises(FileNotFoundError, match=r"none\.csv not found"):
        read_recordings(write(TEXT), tmp_path / "none.csv")
    with pytest.raises(ValueError, match=r"a \.csv or an \.npz file, got '\.txt'"):
        read_recordings(write(TEXT, "drives.txt"))


# --- NumPy ---------------------------------------------------------------------------------------


def arrays(**changes) -> dict[str, np.ndarray]:
    """Two trajectories, of three and two points."""
    values = {name: np.arange(6.0).reshape(2, 3) + i for i, name in enumerate(COLUMNS)}
    for array in values.values():
        array[1, 2] = np.nan
    values |= changes
    return {name: array for name, array in values.items() if array is not None}


def save(folder: Path, **changes) -> Path:
    np.savez(folder / "drives.npz", **arrays(**changes))
    return folder / "drives.npz"


def test_npz(tmp_path):
    boxes = np.full((2, 2, 5), 0.5)
    boxes[0, 1] = np.nan
    names = np.array(["left", "right"])
    first, second = read_recordings(save(tmp_path, boxes=boxes, trajectory=names))
    assert (first.name, second.name) == ("left", "right")
    assert first.time.tolist() == [0.0, 1.0, 2.0]
    assert second.position.tolist() == [[4.0, 5.0], [5.0, 6.0]]
    assert first.heading is None
    assert (len(first.boxes), len(second.boxes)) == (1, 2)
    assert second.places == ("point 0", "point 1")


def test_human_and_goal_may_be_given_once(tmp_path):
    goal, human = np.array([7.0, 8.0]), np.array([1, 2], dtype=np.int32)
    first, second = read_recordings(save(tmp_path, goal_x=goal, human_y=human))
    assert first.goal[:, 0].tolist() == [7.0] * 3
    assert second.human[:, 1].tolist() == [2.0] * 2


def test_nan_before_the_end_is_no_padding(tmp_path):
    x = arrays()["x"]
    x[0, 1] = np.nan
    first, _ = read_recordings(save(tmp_path, x=x))
    assert len(first.time) == 3
    assert np.isnan(first.position[1, 0])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"goal_x": None}, r"missing: \['goal_x'\]"),
        ({"speed": np.zeros((2, 3))}, r"unknown: \['speed'\]"),
        ({"time": np.zeros(3)}, r"array time: expected shape \[N, T\], got \[3\]"),
        ({"x": np.zeros((2, 4))}, r"array x: expected shape \[2, 3\], got \[2, 4\]"),
        ({"goal_y": np.zeros(3)}, r"array goal_y: expected shape \[2, 3\] or \[2\], got \[3\]"),
        ({"x": np.full((2, 3), "1")}, r"array x: expected real numbers, got <U1"),
        ({"heading": np.zeros(2)}, r"array heading: expected shape \[2, 3\], got \[2\]"),
        ({"boxes": np.zeros((2, 5))}, r"array boxes: expected shape \[N, M, 5\], got \[2, 5\]"),
        ({"boxes": np.ones((3, 1, 5))}, r"array boxes: expected shape \[2, 1, 5\]"),
        ({"boxes": np.zeros((2, 1, 5))}, r"array boxes, trajectory '0': a box needs"),
        ({"trajectory": np.array(["a", "a"])}, r"array trajectory: expected 2 different names"),
        ({"x": np.array([[None] * 3] * 2)}, r"is not an \.npz file of plain arrays"),
    ],
)
def test_npz_errors(tmp_path, changes, message):
    path = save(tmp_path, **changes)
    with pytest.raises(ValueError, match=rf"drives\.npz.*{message}"):
        read_recordings(path)


@pytest.mark.parametrize("content", [b"", b"no archive", b"PK\x03\x04 broken"])
def test_a_broken_npz_file(tmp_path, content):
    path = tmp_path / "drives.npz"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"drives\.npz is not an \.npz file of plain arrays"):
        read_recordings(path)


def test_an_npy_file_under_the_wrong_name(tmp_path):
    with (tmp_path / "drives.npz").open("wb") as file:
        np.save(file, np.zeros((2, 3)))
    with pytest.raises(ValueError, match=r"drives\.npz is not an \.npz file of plain arrays"):
        read_recordings(tmp_path / "drives.npz")


def test_boxes_of_an_npz_file_are_inside(tmp_path, write):
    with pytest.raises(ValueError, match=r"the boxes of an \.npz file are its array 'boxes'"):
        read_recordings(save(tmp_path), write(BOXES, "boxes.csv"))
