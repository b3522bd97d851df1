"""What the demo and the film are asked for: one line where it cannot be, and nothing is overwritten."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

import recipes.demo.__main__ as demo
from recipes import film
from recipes.outputs import check_new_file, claim_folder


def test_the_default_folder_is_never_used_twice(tmp_path):
    default = tmp_path / "runs" / "demo"
    folders = [claim_folder(None, default) for _ in range(3)]
    assert [folder.name for folder in folders] == ["demo", "demo-2", "demo-3"]
    assert all(folder.is_dir() for folder in folders)
    folders[1].rmdir()
    folders[1].write_text("a file is no free name either")
    assert claim_folder(None, default).name == "demo-4"


def test_a_chosen_folder_is_new_or_empty(tmp_path):
    assert claim_folder(tmp_path / "a" / "new", Path("unused")).is_dir()
    assert claim_folder(tmp_path / "a" / "new", Path("unused")) == tmp_path / "a" / "new"
    with pytest.raises(ValueError, match="is not empty, and nothing is overwritten"):
        claim_folder(tmp_path / "a", Path("unused"))


def make_file(tmp_path: Path) -> Path:
    (tmp_path / "file").write_text("mine")
    return tmp_path / "file"


def test_a_place_that_is_none(tmp_path):
    file = make_file(tmp_path)
    with pytest.raises(ValueError, match="is a file: choose a folder"):
        claim_folder(file, Path("unused"))
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    with pytest.raises(ValueError, match="is a link to nothing"):
        claim_folder(tmp_path / "link", Path("unused"))
    with pytest.raises(ValueError, match="exists and is not overwritten"):
        check_new_file(tmp_path / "link")
    for refuse in (
        lambda: claim_folder(file / "folder", Path("unused")),
        lambda: claim_folder(None, file / "runs" / "demo"),
        lambda: check_new_file(file / "film.gif"),
    ):
        with pytest.raises(ValueError, match="file is not a folder: choose another place"):
            refuse()
    assert file.read_text() == "mine"


def test_a_place_that_cannot_be_written():
    """Not by root either, who may do everything."""
    nowhere = Path("/proc/films")
    for refuse in (
        lambda: claim_folder(nowhere, Path("unused")),
        lambda: claim_folder(None, nowhere / "demo"),
        lambda: check_new_file(nowhere / "film.gif"),
    ):
        with pytest.raises(ValueError, match=r"/proc cannot be written \(.*\): choose another"):
            refuse()


@pytest.mark.parametrize(
    ("module", "arguments", "message"),
    [
        (
            demo,
            ["--seed", "-1"],
            "--seed: must be a whole number from 7 to 9999, got '-1'",
        ),
        (demo, ["--seed", "0.5"], "got '0.5'"),
        (demo, ["--episodes", "0"], "--episodes: must be a whole number from 1 to 10000, got '0'"),
        (demo, ["--episodes", "999999999"], "got '999999999'"),
        (demo, ["--steps", "1"], "--steps: must be a whole number from 2 to 1000, got '1'"),
        (demo, ["--policy", "nowhere"], "nowhere"),
        (demo, ["--output", "full"], "--output full is not empty"),
        (film, ["--output", "a.gif", "--seed", "-1"], "--seed: must be a whole number from 0"),
        (film, ["--output", "a.gif", "--seed", str(2**32)], f"got '{2**32}'"),
        (film, ["--output", "a.gif", "--policy", "nowhere"], "nowhere"),
        (film, ["--output", "a.gif", "--scene", "moon"], "moon"),
        (film, ["--output", "full/mine/a.gif"], "full/mine is not a folder"),
        (film, ["--output", "full"], "must end in .gif or .mp4, got 'full'"),
    ],
)
def test_mistakes_are_one_line(module, arguments, message, tmp_path, monkeypatch, capsys):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine").write_text("untouched")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["recipe", *arguments])
    with pytest.raises(SystemExit) as exit_:
        module.main()
    assert exit_.value.code == 2
    *usage, line = capsys.readouterr().err.strip().splitlines()
    assert message in line and "error: " in line
    assert not any("error" in other for other in usage)
    assert [path.name for path in sorted(tmp_path.rglob("*"))] == ["full", "mine"]
