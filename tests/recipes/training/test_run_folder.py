"""Run folders: claimed by one run alone, and written whole or not at all."""

from __future__ import annotations

import errno
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from recipes.training import run_folder


def test_processes_that_start_at_once_claim_different_folders(tmp_path):
    code = (
        "import sys; from pathlib import Path; from recipes.training.run_folder import claim\n"
        "sys.stdin.readline()\n"  # all wait for the same moment
        "print(*[claim(Path(sys.argv[1])).name for _ in range(20)])"
    )
    children = [
        subprocess.Popen(
            [sys.executable, "-c", code, str(tmp_path / "runs")],
            cwd=Path(run_folder.__file__).parents[2],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        for _ in range(3)
    ]
    for child in children:
        child.stdin.write("\n")
        child.stdin.flush()
    claimed = [name for child in children for name in child.communicate()[0].split()]
    assert len(claimed) == len(set(claimed)) == 60
    assert {path.name for path in (tmp_path / "runs").iterdir()} == set(claimed)


def test_names_of_one_second_are_numbered(tmp_path, monkeypatch):
    monkeypatch.setattr("time.strftime", lambda pattern: "now")
    assert [run_folder.claim(tmp_path).name for _ in range(3)] == ["now", "now-2", "now-3"]
    assert run_folder.free_name(tmp_path).name == "now-4"
    assert len(list(tmp_path.iterdir())) == 3


def test_what_another_process_takes_first_is_left_to_it(tmp_path, monkeypatch):
    monkeypatch.setattr("time.strftime", lambda pattern: "now")
    free_name = run_folder.free_name

    def late(base: Path) -> Path:
        monkeypatch.setattr(run_folder, "free_name", free_name)
        (base / "now").mkdir()  # between our look and our mkdir
        return base / "now"

    monkeypatch.setattr(run_folder, "free_name", late)
    assert run_folder.claim(tmp_path).name == "now-2"


def test_a_file_is_there_whole_or_not_at_all(tmp_path, monkeypatch):
    path = tmp_path / "run.json"
    run_folder.write_atomically(path, "old")

    def fail(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("os.fsync", fail)
    with pytest.raises(OSError, match="No space left"):
        run_folder.write_atomically(path, "new")
    assert path.read_text() == "old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["run.json"]


def test_starts_are_added_and_nothing_is_overwritten(tmp_path):
    run_folder.write_run_info(tmp_path)
    first = json.loads((tmp_path / "run.json").read_text())
    assert first["versions"]["torch"] and "resumed" not in first
    diffs = {path: path.read_bytes() for path in tmp_path.glob("*.diff")}
    for count in (1, 2):
        run_folder.write_run_info(tmp_path)
        info = json.loads((tmp_path / "run.json").read_text())
        assert len(info.pop("resumed")) == count
        assert info == first
    assert all(path.read_bytes() == content for path, content in diffs.items())


@pytest.mark.parametrize("entry", ["policies/x", ".hydra/config.yaml", "notes"])
def test_a_folder_that_holds_something_is_not_new(entry, tmp_path):
    run_folder.check_new(tmp_path / "run")
    (tmp_path / "run" / entry).parent.mkdir(parents=True)
    (tmp_path / "run" / entry).write_text("")
    with pytest.raises(
        FileExistsError, match=r"exists and is not overwritten: choose another x\.y\."
    ):
        run_folder.check_new(tmp_path / "run", "x.y")


def test_only_what_hydra_wrote_is_removed(tmp_path):
    for name in ("refused", "begun", "mine"):
        (tmp_path / name / ".hydra").mkdir(parents=True)
    (tmp_path / "begun" / "run.json").write_text("{}")
    run_folder.remove_if_refused(tmp_path / "refused")
    run_folder.remove_if_refused(tmp_path / "begun")
    run_folder.remove_if_refused(tmp_path / "mine", keep=True)
    run_folder.remove_if_refused(tmp_path / "nowhere")
    assert sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")) == [
        *("begun", "begun/.hydra", "begun/run.json", "mine")
    ]


@pytest.fixture
def tiny_disk(tmp_path) -> Iterator[Path]:
    """A file system of 1.5 MB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=1536k", "none", str(folder)]
    try:
        if subprocess.run(mount, capture_output=True).returncode:
            pytest.skip("needs the right to mount")
    except FileNotFoundError:
        pytest.skip("needs mount")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


def test_a_full_disk_is_one_line_and_costs_the_checkpoint_not_the_policy(tiny_disk):
    """As a user runs it: the policy, 0.3 MB, fits; the checkpoint with its optimizers does not."""
    options = (
        "collector.total_frames=576 collector.init_random_frames=480 evaluation.interval=96 "
        "evaluation.episodes=2 replay_buffer.batch_size=16 replay_buffer.size=960 "
        "network.num_cells=[256,256] env.max_episode_steps=5 optim.updates_per_batch=2 "
        "compute.compile=false compute.bfloat16=false logger.backends=[]"
    )
    result = subprocess.run(
        [
            *(sys.executable, "-m", "recipes.pd_morl.pd_morl", *options.split()),
            f"hydra.run.dir={tiny_disk / 'run'}",
        ],
        cwd=Path(run_folder.__file__).parents[2],
        capture_output=True,
        text=True,
    )
    assert result.returncode == 1, result.stderr
    last = result.stderr.splitlines()[-1]
    assert last.startswith(f"error: {tiny_disk}/run"), last
    assert "No space left on device" in last and "MB are" in last
    assert "Traceback" not in result.stderr
    assert (tiny_disk / "run" / "policies" / "000000576" / "policy.json").is_file()
