"""Reading recorded trajectories: what is read, and an error that names file, line and column."""

from __future__ import annotations

import io
import re
import zipfile
from pathlib import Path

import numpy as np
import pytest

from envs.demonstrations.reading import open_recordings, read_recordings
from envs.demonstrations.recordings import COLUMNS

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
    assert [first.place(index) for index in range(2)] == ["line 2", "line 4"]
    assert second.heading is None
    assert second.boxes.shape == (0, 5)
    assert [second.place(index) for index in range(2)] == ["line 3", "line 6"]


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
        ("goal_x,", "", "line 1: the header must name .*missing: ['goal_x'], unknown: []"),
        ("human_x,human_y,", "", "line 1: .*missing: ['human_x', 'human_y']"),
        ("heading", "headng", "line 1: .*may name heading.*unknown: ['headng']"),
        ("heading", "y", "line 1: the header must name .*each once.*twice: ['y']"),
        (HEADER, HEADER.replace(",", " "), "separated by commas, semicolons or tabs"),
        (HEADER, "", "line 2: the header must name"),
        (TEXT, HEADER, "holds no trajectory"),
        (TEXT, "", "is empty: it needs a header, trajectory,time,x,y,"),
        (TEXT, "\n \n", "is empty: it needs a header"),
        (TEXT, "\n\n# nothing\n", "holds nothing but comments: it needs a header"),
        (
            "b,0.0",
            "time,x,y,trajectory,human_x,human_y,goal_x,goal_y\nb,0.0",
            "line 3: a second header",
        ),
        (TEXT, HEADER + "\n,0,0,0,0,0,0,0,0\n", "line 2, column trajectory: the cell is empty"),
    ],
)
def test_a_csv_file_that_is_none(write, old, new, message):
    assert old in TEXT
    path = write(TEXT.replace(old, new, 1))
    pattern = re.escape(message).replace(r"\.\*", ".*")
    with pytest.raises(ValueError, match=rf"drives\.csv.*{pattern}") as error:
        read_recordings(path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("a,3", "c,3", r"boxes\.csv, line 3: .*drives\.csv has no trajectory 'c'"),
        ("a,3", "a,3,1", r"boxes\.csv, line 3: 7 cells, but 6 columns"),
        ("a,3", ",3", r"boxes\.csv, line 3, column trajectory: the cell is empty"),
        ("0.2,0.2\n", "0.2", r"boxes\.csv, line 3 is cut off"),
        ("0.1,0.2", "90,0.2", r"boxes\.csv, line 3, column yaw: 90 in yaw: degrees\?.*Radians"),
        ("yaw", "angle", r"boxes\.csv, line 1: .*missing: \['yaw'\], unknown: \['angle'\]"),
    ],
)
def test_a_file_of_boxes_that_is_none(write, old, new, message):
    """A drive must not lose a box: what cannot be assigned is an error of the file."""
    assert old in BOXES
    with pytest.raises(ValueError, match=message) as error:
        read_recordings(write(TEXT), write(BOXES.replace(old, new), "boxes.csv"))
    assert "\n" not in str(error.value)


def test_a_trajectory_of_almost_that_name_is_proposed(write):
    drives = write(TEXT.replace("a,", "morning 1,"))
    boxes = write(BOXES.replace("\na,", "\nmorning1,"), "boxes.csv")
    with pytest.raises(ValueError, match=r"no trajectory 'morning1'\. Is 'morning 1' meant\?"):
        read_recordings(drives, boxes)


@pytest.mark.parametrize(
    ("new", "message"),
    [
        ("0.2,0", r"line 3: a box needs .* positive half sizes"),
        ("0.2,nan", "line 3: a box needs finite"),
        ("0.2,", "line 3, column half_width: the cell is empty"),
    ],
)
def test_a_wrong_box_costs_its_drive(write, new, message):
    boxes = write(BOXES.replace("0.2,0.2", new), "boxes.csv")
    first, second = read_recordings(write(TEXT), boxes)
    assert re.search(rf"boxes\.csv, {message}", first.faults[0])
    assert not second.faults


def test_numbers_without_sense_are_read(write):
    # They reject one trajectory, not the file: see the feasibility check.
    first, _ = read_recordings(write(TEXT.replace("1.1,", "nan,").replace("3.5", "inf")))
    assert np.isnan(first.position[1, 0])
    assert np.isinf(first.human[1, 0])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"\xff\xfe\x00\x01" * 50, "is UTF-16: save it as UTF-8"),
        (TEXT.encode("utf-16"), "is UTF-16: save it as UTF-8"),
        (TEXT.encode("utf-16-le"), "is not a text file"),
        (b"PK\x03\x04\x00\x00workbook" * 99, "is not a text file"),
        (TEXT.replace("b,", "Tür,").encode("latin-1"), "line 3 is not UTF-8"),
    ],
)
def test_a_csv_file_that_is_no_text(tmp_path, content, message):
    path = tmp_path / "drives.csv"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=rf"drives\.csv.* {message}") as error:
        read_recordings(path)
    assert "\n" not in str(error.value)


def test_names_are_unicode(write):
    assert [one.name for one in read_recordings(write(TEXT.replace("b,", "Tür ß 日,")))][
        1
    ] == "Tür ß 日"


def test_missing_files_and_other_types(write, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.csv does not exist"):
        read_recordings(tmp_path / "none.csv")
    with pytest.raises(FileNotFoundError, match=r"none\.csv does not exist"):
        read_recordings(write(TEXT), tmp_path / "none.csv")
    with pytest.raises(FileNotFoundError, match="is a folder, not a file"):
        read_recordings(tmp_path)
    with pytest.raises(ValueError, match=r"a \.csv or an \.npz file or a ROS bag, got '\.txt'"):
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
    assert [second.place(index) for index in range(2)] == ["point 0", "point 1"]


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
        ({"time": np.zeros(3)}, r"array time: expected .* got \[3\]: .*time\[None\]"),
        ({"x": np.zeros((2, 4))}, r"array x: expected shape \[2, 3\], got \[2, 4\]"),
        ({"goal_y": np.zeros(3)}, r"array goal_y: expected shape \[2, 3\] or \[2\], got \[3\]"),
        ({"x": np.full((2, 3), "1")}, r"array x: expected real numbers, got <U1"),
        ({"heading": np.zeros(2)}, r"array heading: expected shape \[2, 3\], got \[2\]"),
        ({"boxes": np.zeros((2, 5))}, r"array boxes: expected shape \[N, M, 5\], got \[2, 5\]"),
        ({"boxes": np.ones((3, 1, 5))}, r"array boxes: expected shape \[2, 1, 5\]"),
        (
            {"boxes": np.full((2, 1, 5), 90.0)},
            r"array boxes, trajectory '0', column yaw: 90 in yaw",
        ),
        ({"trajectory": np.array(["a", "a"])}, r"expected 2 different names; twice: \['a'\]"),
        ({"trajectory": np.array(["a"])}, r"expected 2 different names, got shape \[1\]"),
        ({"x": np.array([[None] * 3] * 2)}, r"is not an \.npz file of plain arrays"),
    ],
)
def test_npz_errors(tmp_path, changes, message):
    path = save(tmp_path, **changes)
    with pytest.raises(ValueError, match=rf"drives\.npz.*{message}"):
        read_recordings(path)


def test_a_wrong_box_of_an_npz_file_costs_its_drive(tmp_path):
    boxes = np.full((2, 1, 5), 0.5)
    boxes[1, 0, 4] = -1
    first, second = read_recordings(save(tmp_path, boxes=boxes))
    assert not first.faults
    assert "array boxes, trajectory '1': a box needs" in second.faults[0]


def test_names_may_be_bytes_or_numbers(tmp_path):
    for names, read in (
        (np.array([b"a", b"\xc3\xa9"]), ["a", "é"]),
        (np.array([3, 1]), ["3", "1"]),
    ):
        assert [one.name for one in read_recordings(save(tmp_path, trajectory=names))] == read


def test_a_flipped_bit_in_an_npz_file(tmp_path):
    np.savez_compressed(tmp_path / "drives.npz", **arrays(x=np.random.rand(2, 3)))
    content = bytearray((tmp_path / "drives.npz").read_bytes())
    # The stored numbers of the first array, behind its header.
    content[80] ^= 255
    (tmp_path / "drives.npz").write_bytes(content)
    with pytest.raises(ValueError, match=r"drives\.npz is not an \.npz file of plain arrays"):
        read_recordings(tmp_path / "drives.npz")


@pytest.mark.parametrize("content", [b"no archive", b"PK\x03\x04 broken"])
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


# --- one at a time -------------------------------------------------------------------------------


def test_a_drive_is_read_without_those_after_it(write):
    """What makes memory a matter of the drives, not of the file."""
    rows = [f"{drive},{0.1 * i},0,0,0,0,0,0" for drive in range(3) for i in range(4)]
    header = HEADER.replace("heading,", "")
    file = open_recordings(write("\n".join([header, *rows])))
    assert len(file) == 3
    drives = iter(file)
    assert next(drives).name == "0"
    file.__dict__["_table"].numbers = lambda line: pytest.fail(f"line {line.number} is read early")
    with pytest.raises(pytest.fail.Exception, match="line 6 is read early"):
        next(drives)


@pytest.mark.parametrize("name", ["drives.csv", "drives.npz"])
def test_an_empty_file_is_called_so(name, tmp_path):
    (tmp_path / name).touch()
    with pytest.raises(ValueError, match=rf"{name} is empty: it (needs a header|must hold)"):
        read_recordings(tmp_path / name)


def test_an_npz_file_that_promises_more_than_there_is(tmp_path):
    """NumPy allocates what the header of an array says."""
    np.savez(tmp_path / "drives.npz", **arrays())
    member = "x.npy"
    with zipfile.ZipFile(tmp_path / "drives.npz") as archive:
        contents = {name: archive.read(name) for name in archive.namelist()}
    header = {"descr": "<f8", "fortran_order": False, "shape": (2**40, 2**10)}
    with zipfile.ZipFile(tmp_path / "drives.npz", "w") as archive:
        for one, content in contents.items():
            if one == member:
                file = io.BytesIO()
                np.lib.format.write_array_header_1_0(file, header)
                content = file.getvalue()
            archive.writestr(one, content)
    with pytest.raises(ValueError, match=r"drives\.npz is not an \.npz file of plain arrays"):
        read_recordings(tmp_path / "drives.npz")
