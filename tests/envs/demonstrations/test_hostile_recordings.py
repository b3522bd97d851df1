"""Files of drives that somebody else has made, or a spreadsheet has spoiled: one line, at once, nothing written."""

from __future__ import annotations

import gzip
import os
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from recipes import import_demonstrations, stages, teach
from tests._command import run_here

HEADER = "trajectory,time,x,y,human_x,human_y,goal_x,goal_y"
DRIVE = [f"a,{0.2 * i:.1f},{0.08 * i:.2f},0,2,1.5,4,0" for i in range(60)]
TEXT = "\n".join([HEADER, *DRIVE]) + "\n"


def holds(content: str | bytes) -> Callable[[Path], None]:
    data = content.encode() if isinstance(content, str) else content
    return lambda path: path.write_bytes(data)


def links_to(target: str) -> Callable[[Path], None]:
    return lambda path: path.symlink_to(target)


def instead(old: str, new: str) -> Callable[[Path], None]:
    assert old in TEXT
    return holds(TEXT.replace(old, new))


def folder_of_drives(path: Path) -> None:
    path.mkdir()
    (path / "mine.csv").write_text(TEXT)


SECOND = DRIVE[1]
HOSTILE = {
    "nothing there": (lambda path: None, "does not exist"),
    "a link to nothing": (links_to("nowhere"), "is a link to nowhere, which is not there"),
    "a loop of links": (links_to("drives.csv"), "is a loop of links"),
    "a pipe": (os.mkfifo, "is a pipe or a device, not a file"),
    "a device without an end": (links_to("/dev/zero"), "is a pipe or a device, not a file"),
    "a folder with the file in it": (folder_of_drives, "mine.csv meant?"),
    "an empty folder": (Path.mkdir, "is a folder, not a file, and holds no .csv, .npz or ROS bag"),
    "nothing in it": (holds(b""), "is empty: it needs a header, trajectory,time,x,y"),
    "a byte order mark alone": (holds(b"\xef\xbb\xbf"), "is empty: it needs a header"),
    "headers only": (holds(HEADER + "\n"), "holds no trajectory"),
    "headers again and again": (holds((HEADER + "\n") * 999), "holds no trajectory"),
    "UTF-16": (holds(TEXT.encode("utf-16")), "is UTF-16: save it as UTF-8"),
    "UTF-32": (holds(TEXT.encode("utf-32")), "save it as UTF-8"),
    "gzip under another name": (holds(gzip.compress(TEXT.encode())), "compressed by gzip: unpack"),
    "a picture": (holds(b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR"), "is not a text file"),
    "zeros alone": (holds(b"\0" * 10_000), "is not a text file"),
    "a zero far behind": (
        holds(HEADER + "\n" + " \n" * 5000 + SECOND.replace("0.08", "0.0\0") + "\n"),
        "line 5002, column x: '0.0\\x00' is not a number",
    ),
    "a million columns": (holds("x," * 1_000_000 + "\n"), "the header must name the columns"),
    "a million different columns": (
        holds(",".join(map(str, range(1_000_000))) + "\n"),
        "the header must name the columns",
    ),
    "a million cells": (instead(SECOND, "a," * 1_000_000), "1000000 cells, but 8 columns"),
    "a line of 50 MB": (holds("x" * 50_000_000), "the header must name the columns"),
    "a cell of 50 MB": (instead(SECOND, SECOND.replace("0.08", "x" * 50_000_000)), "not a number"),
    "a name of a megabyte": (
        instead("a,", "a" * 1_000_000 + ","),
        "is no name of up to 200 characters",
    ),
    "a name in colours": (instead("a,", "\x1b[31ma,"), "'\\x1b[31ma' is no name of up to 200"),
    "quoted lines": (instead(SECOND, '"a\n",' + SECOND[2:]), "line 3: unexpected end of data"),
    "a formula": (instead("0.08", "=cmd()"), "line 3, column x: '=cmd()' is not a number"),
    "negative times": (instead("a,0.2", "a,-0.2"), "time goes back from 0 to -0.2 s at line 3"),
    "repeated times": (instead("a,0.2", "a,0.0"), "time stands still at line 3"),
    "infinite": (instead("0.08", "inf"), "column x is not finite at line 3"),
    "1e308": (instead("0.08", "1e308"), "column x is beyond all sense, 1e+308, at line 3"),
    "all of 1e308": (instead(",2,1.5", ",1e308,-1e308"), "column human_x is beyond all sense"),
    "times of 1e308": (instead("a,0.2", "a,1e308"), "column time is beyond all sense"),
    "another table": (holds("name,age\nBob,7\n"), "missing: ['trajectory', 'time', 'x'"),
    "a page": (holds("<!DOCTYPE html><html><body>404</body></html>\n"), "the header must name"),
}


@pytest.fixture(autouse=True)
def nothing_is_trained(monkeypatch):
    """A file that is taken after all must not begin a training."""
    monkeypatch.setattr(stages, "run", lambda name, command: pytest.fail(f"{name} begins"))


def shown(command: Callable[[], None], *arguments: object, capsys: pytest.CaptureFixture) -> str:
    """What a command that refuses prints, one line, within seconds."""
    started = time.perf_counter()
    with pytest.raises(SystemExit) as stop:
        run_here(command, *map(str, arguments))
    assert time.perf_counter() - started < 20
    out, err = capsys.readouterr()
    assert (stop.value.code, out) == (2, "")
    return err


@pytest.mark.parametrize("name", HOSTILE)
@pytest.mark.parametrize("command", [import_demonstrations, teach], ids=["import", "teach"])
def test_it_is_refused_in_one_line(command, name, tmp_path, monkeypatch, capsys):
    make, line = HOSTILE[name]
    (tmp_path / "drives").mkdir()
    monkeypatch.chdir(tmp_path / "drives")
    file = Path("drives.csv")
    make(file)
    given = ["--output", "out.safetensors"] if command is import_demonstrations else []
    err = shown(command.main, file, *given, capsys=capsys)
    assert line in err
    assert err.count("\n") == 1 and len(err) < 1000
    assert "drives.csv" in err
    assert [path.name for path in Path().iterdir()] in (["drives.csv"], [])


def test_where_it_was_looked_for(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    err = shown(teach.main, "mine.csv", capsys=capsys)
    assert f"'mine.csv' does not exist (searched from {tmp_path})" in err


@pytest.mark.parametrize("name", ["a" * 5000, "a\0b.csv", "x.csv/drives.csv"])
def test_paths_that_cannot_be(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("x.csv").write_text(TEXT)
    for command in (teach.main, import_demonstrations.main):
        err = shown(command, name, "--output", "out.safetensors", capsys=capsys)
        assert err.count("\n") == 1 and len(err) < 600


def test_a_file_that_must_not_be_read_says_so(tmp_path, monkeypatch, capsys):
    """Root may read everything: what the system would say is said for it."""
    monkeypatch.chdir(tmp_path)
    Path("drives.csv").write_text(TEXT)
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    for command in (teach.main, import_demonstrations.main):
        err = shown(command, "drives.csv", "--output", "out.safetensors", capsys=capsys)
        assert "drives.csv" in err and "cannot be read: Permission denied" in err


def test_a_pipe_of_boxes_and_a_bag_that_is_one(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("drives.csv").write_text(TEXT)
    os.mkfifo("boxes.csv")
    os.mkfifo("bag.mcap")
    Path("bags").mkdir()
    os.mkfifo("bags/bag.mcap")
    for given in (["drives.csv", "--boxes", "boxes.csv"], ["bag.mcap"], ["bags"]):
        for command in (teach.main, import_demonstrations.main):
            err = shown(command, *given, "--output", "out.safetensors", capsys=capsys)
            assert "is a pipe or a device" in err


def test_a_gap_of_all_time_fills_no_memory(tmp_path, monkeypatch, capsys):
    """Every control step between two points would be a point."""
    monkeypatch.chdir(tmp_path)
    Path("drives.csv").write_text(TEXT.replace("a,11.8", "a,1e15"))
    given = ["--output", "out.safetensors", "--gap-tolerance", "1e20"]
    err = shown(import_demonstrations.main, "drives.csv", *given, capsys=capsys)
    assert "longer than 1,000,000 control steps" in err
