"""What may be wrong with a file of drives: handled, or it costs the drive with line and reason."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from envs.demonstrations.feasibility import check
from envs.demonstrations.importer import import_demonstrations
from envs.demonstrations.reading import open_recordings, read_recordings
from envs.demonstrations.recordings import COLUMNS
from envs.demonstrations.report import NoDriveAcceptedError

HEADER = "trajectory,time,x,y,heading,human_x,human_y,goal_x,goal_y"
POINTS = 60
# "a" stands at lines 2 to 61, "b" at 62 to 121, "c" at 122 to 181.
ROWS = [
    f"{name},{0.2 * i:.1f},{0.08 * i:.2f},0,0.0,2,1.5,4,0" for name in "abc" for i in range(POINTS)
]
FIRST, LINE, LAST = 62, 72, 181
GOOD = "b,2.0,0.80,0,0.0,2,1.5,4,0"


def text(replaced: dict[int, str] | None = None) -> str:
    """The file with other lines at these numbers; a line may become none or several."""
    lines = [HEADER, *ROWS]
    for number, other in (replaced or {}).items():
        lines[number - 1] = other
    return "\n".join(lines) + "\n"


def outcome(path: Path, boxes: Path | None = None) -> dict[str, str]:
    return {
        recording.name: "; ".join(map(str, check(recording)[1]))
        for recording in read_recordings(path, boxes)
    }


@pytest.fixture
def drives(tmp_path) -> Path:
    return tmp_path / "drives.csv"


def test_the_drives_that_all_of_it_spoils_are_good(drives):
    assert text().splitlines()[LINE - 1] == GOOD
    drives.write_text(text())
    assert outcome(drives) == {"a": "", "b": "", "c": ""}


COSTS_ITS_DRIVE = {
    "an empty cell": (GOOD.replace("0.80", ""), "line 72, column x: the cell is empty"),
    "N/A": (GOOD.replace("0.80", "N/A"), "line 72, column x: 'N/A' is not a number"),
    "a word": (GOOD.replace("1.5", "left"), "line 72, column human_y: 'left' is not a number"),
    "a unit": (GOOD.replace("0.80", "0.80 m"), "line 72, column x: '0.80 m' is not a number"),
    "nan": (GOOD.replace("0.80", "nan"), "column x is not finite at line 72"),
    "inf": (GOOD.replace("0.80", "-inf"), "column x is not finite at line 72"),
    "1e999": (GOOD.replace("0.80", "1e999"), "column x is not finite at line 72"),
    "an underscore": (GOOD.replace("0.80", "0.8_0"), "line 72: an underscore in a number"),
    "one empty heading": (GOOD.replace("0.0,2", ",2"), "column heading is not finite at line 72"),
    "a heading of N/A": (GOOD.replace("0.0,2", "N/A,2"), "column heading is not finite at line 72"),
    "too few cells": ("b,2.0,0.8", "line 72: 3 cells, but 9 columns"),
    "too many cells": (GOOD.replace("2,1.5", "2,0,1.5"), "line 72: 10 cells, but 9 columns"),
    "a decimal comma": (
        GOOD.replace("0.80", "0,80"),
        "line 72: 10 cells, but 9 columns (for decimal",
    ),
    "a quoted decimal comma": (
        GOOD.replace("0.80", '"0,80"'),
        "line 72, column x: '0,80' is not a number, numbers have decimal points",
    ),
    "no name": (GOOD.replace("b,", ","), "line 72, column trajectory: the cell is empty"),
    "a quote that is not closed": ('"' + GOOD, "line 72: unexpected end of data"),
    "half a name": ("b", "line 72: 1 cells, but 9 columns"),
    "time stands": (GOOD.replace("2.0", "1.8"), "time stands still at line 72, 1.8 s"),
    "time goes back": (GOOD.replace("2.0", "0.0"), "time goes back from 1.8 to 0 s at line 72"),
    "a goal of its own": (GOOD.replace("4,0", "4,1"), "the goal moves by 1.00 m, most at line 72"),
    "a jump": (GOOD.replace("0.80", "8.0"), "drives at 36.40 m/s at 1.80 s"),
}


@pytest.mark.parametrize("name", COSTS_ITS_DRIVE)
def test_a_faulty_line_costs_its_drive(drives, name):
    line, reason = COSTS_ITS_DRIVE[name]
    drives.write_text(text({LINE: line}))
    reasons = outcome(drives)
    assert (reasons.pop("a"), reasons.pop("c")) == ("", "")
    assert reasons.pop("b").startswith(reason)
    assert not reasons


def test_several_faults_are_counted(drives):
    drives.write_text(text({LINE: "b,2.0,,0,0.0,2,1.5,4,0", LINE + 3: "b", LINE + 4: "b,x"}))
    assert outcome(drives)["b"] == "line 72, column x: the cell is empty, and 2 more line(s)"


def test_a_line_without_a_name_at_the_start_costs_the_first_drive(drives):
    drives.write_text(text({2: ROWS[0].replace("a,", ",", 1)}))
    assert outcome(drives) == {
        "a": "line 2, column trajectory: the cell is empty",
        "b": "",
        "c": "",
    }


HANDLED = {
    "a repeated line": ({LINE: f"{GOOD}\n{GOOD}"}, ["left out 1 repeated point(s) of 1 drive(s)"]),
    "comments": ({1: "# drives\n" + HEADER, LINE: f"#{GOOD}\n{GOOD}"}, ["left out 2 comment line(s)"]),
    "a header of numpy.savetxt": ({1: "# " + HEADER}, []),
    "a line sep=": ({1: "sep=,\n" + HEADER}, []),
    "a repeated header": ({FIRST: f"{HEADER}\n{ROWS[60]}"}, ["left out 1 repeated header(s)"]),
    "a byte order mark in the middle": (
        {FIRST: f"\ufeff{HEADER}\n{ROWS[60]}"},
        ["left out 1 repeated header(s)"],
    ),
    "blank lines": ({LINE: f"\n   \n{GOOD}\n\t\n"}, []),
    "blank cells": ({LINE: f",,,,,,,,\n{GOOD}"}, []),
    "scientific notation": ({LINE: GOOD.replace("0.80", "8.0E-01")}, []),
    "a sign": ({LINE: GOOD.replace("0.80", "+.8")}, []),
    "spaces": ({LINE: " " + GOOD.replace(",", " , ") + "  "}, []),
    "quotes": ({LINE: ",".join(f'"{cell}"' for cell in GOOD.split(","))}, []),
    "a trailing separator": ({1: HEADER + ",", LINE: GOOD + ",", LINE + 1: ROWS[LINE - 1] + ",,"}, []),
}  # fmt: skip


@pytest.mark.parametrize("name", HANDLED)
def test_it_is_handled(drives, name):
    replaced, notes = HANDLED[name]
    drives.write_text(text(replaced), encoding="utf-8")
    _, report = import_demonstrations(drives, num_threads=1)
    assert (report.accepted, report.rejected, report.notes) == (["a", "b", "c"], {}, notes)


@pytest.mark.parametrize(
    "change",
    [
        lambda text: text.replace("\n", "\r\n"),
        lambda text: text.replace("\n", "\r"),
        lambda text: text.rstrip("\n"),
        lambda text: text.replace(",", ";"),
        lambda text: text.replace(",", "\t"),
        lambda text: text.replace(",", ";").replace(".", ","),
        lambda text: text.replace(",", "\t").replace(".", ","),
        lambda text: "\ufeff" + text,
    ],
    ids=["CRLF", "CR", "no last line end", ";", "tab", "; and decimal commas", "tab and decimal commas", "BOM"],
)  # fmt: skip
def test_the_same_numbers_in_other_clothes(drives, change):
    drives.write_text(text())
    plain = read_recordings(drives)
    with drives.open("w", encoding="utf-8", newline="") as file:
        file.write(change(text()))
    for one, other in zip(read_recordings(drives), plain, strict=True):
        assert (one.name, one.faults) == (other.name, ())
        assert one.rows.tolist() == other.rows.tolist()
        for column, values in other.columns().items():
            assert np.array_equal(one.columns()[column], values)


@pytest.mark.parametrize("suffix", [".CSV", ".Csv"])
def test_capital_suffixes(tmp_path, suffix):
    path = tmp_path / f"DRIVES{suffix}"
    path.write_text(text())
    assert len(read_recordings(path)) == 3


def test_a_capital_npz(tmp_path):
    np.savez(tmp_path / "drives", **{name: np.zeros((2, 3)) for name in COLUMNS})
    path = (tmp_path / "drives.npz").rename(tmp_path / "DRIVES.NPZ")
    assert len(read_recordings(path)) == 2


@pytest.mark.parametrize("cut", [1, 2, 5, 12, 18])
def test_a_last_line_that_is_cut_off_is_left_out(drives, cut):
    """The recorder was stopped while it wrote; the drive counts if it had come to its goal."""
    whole = text()
    drives.write_text(whole[: whole.rindex("\nc,") + 1 + cut])
    file = open_recordings(drives)
    assert file.notes == [f"left out line {LAST}, which is cut off"]
    assert [len(recording.time) for recording in file] == [POINTS, POINTS, POINTS - 1]
    assert outcome(drives) == {"a": "", "b": "", "c": ""}


def test_a_cut_off_line_makes_no_drive(drives):
    drives.write_text(text() + "ddd")
    assert outcome(drives) == {"a": "", "b": "", "c": ""}


def test_two_drives_under_one_name(drives):
    drives.write_text(text().replace("\nc,", "\na,"))
    reasons = outcome(drives)
    assert reasons == {"b": "", "a": "time goes back from 11.8 to 0 s at line 122"}


def test_zeros_as_padding_are_named(tmp_path):
    arrays = {name: np.zeros((1, 70)) for name in COLUMNS}
    i = np.arange(POINTS)
    for name, values in {"time": 0.2 * i, "x": 0.08 * i, "goal_x": 4 + 0 * i}.items():
        arrays[name][0, :POINTS] = values
    np.savez(tmp_path / "drives.npz", **arrays)
    (recording,) = read_recordings(tmp_path / "drives.npz")
    first = check(recording)[1][0]
    assert "goes back from 11.8 to 0 s at point 60" in str(first)
    assert "padding with zeros?" in first.hint


def test_repeated_points_of_an_npz_file_are_left_out(tmp_path):
    arrays = {name: np.repeat(np.arange(6.0)[None], 2, axis=1) for name in COLUMNS}
    np.savez(tmp_path / "drives.npz", **arrays)
    (recording,) = read_recordings(tmp_path / "drives.npz")
    assert recording.time.tolist() == list(range(6))
    assert recording.repeated == 6
    assert recording.place(5) == "point 10"


# --- what is said of many ------------------------------------------------------------------------


def many(path: Path, speeds: list[float]) -> Path:
    """Straight drives at these speeds to a goal at 4 m."""
    rows = [HEADER]
    for drive, speed in enumerate(speeds):
        rows += [
            f"{drive},{0.2 * i:.1f},{0.2 * speed * i:.4f},0,0,2,1.5,4,0"
            for i in range(int(21 / speed))
        ]
    path.write_text("\n".join(rows) + "\n")
    return path


def test_too_fast_drives_are_one_line(drives):
    many(drives, [0.4, 0.4] + [0.7] * 17 + [0.8])
    _, report = import_demonstrations(drives, num_threads=1)
    assert str(report).splitlines() == [
        "2 of 20 drives accepted",
        "  18 of 20 drives faster than turtlebot2's 0.5 m/s (up to 0.8 m/s): "
        "--robot, or --speed-tolerance 0.3",
    ]
    assert len(report.details()) == 18
    assert report.details()[-1].startswith("19: drives at 0.80 m/s at")


def test_if_nothing_is_accepted_the_most_common_reason_comes_first(drives):
    many(drives, [0.7] * 3)
    lines = drives.read_text().splitlines()
    drives.write_text("\n".join([HEADER, "x,0,0,0,0,2,1.5,4,0", *lines[1:]]) + "\n")
    with pytest.raises(NoDriveAcceptedError) as error:
        import_demonstrations(drives, num_threads=1)
    first, second = str(error.value).splitlines()
    assert first == (
        f"{drives}: no drive is accepted: 3 of 4 drives faster than turtlebot2's 0.5 m/s "
        "(up to 0.7 m/s): --robot, or --speed-tolerance 0.2"
    )
    assert second == "  1 of 4 drives of fewer than 2 points (x: has 1 point(s), fewer than 2)"
    assert list(error.value.report.rejected) == ["x", "0", "1", "2"]


def test_a_drive_of_seventy_seconds(drives):
    rows = [f"a,{0.2 * i:.1f},{0.02 * i:.2f},0,0,2,1.5,7,0" for i in range(351)]
    drives.write_text("\n".join([HEADER, *rows]) + "\n")
    with pytest.raises(NoDriveAcceptedError, match=r"\(up to 335 steps\): --max-steps 335"):
        import_demonstrations(drives, num_threads=1)
    data, _ = import_demonstrations(drives, max_steps=335, num_threads=1)
    assert data.shape == (1, 335)
    assert data["next", "done"].nonzero()[:, 1].tolist() == [334]


def test_progress_counts_drives_and_points(drives):
    drives.write_text(text())
    seen = {}

    def progress(iterable, desc):
        for count, item in enumerate(iterable, 1):
            seen[desc] = (count, len(iterable))
            yield item

    import_demonstrations(drives, num_threads=1, progress=progress)
    assert seen == {"reading": (3, 3), "replay": (1, 1)}
