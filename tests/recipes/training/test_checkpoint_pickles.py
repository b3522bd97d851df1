"""A run folder from somebody else: whatever a resume reads of it, a pickle in its place is never run."""

from __future__ import annotations

import os
import pickle
import shutil
import sys
from pathlib import Path

import pytest

from recipes.pd_morl import pd_morl
from tests._command import run_here

TINY = (
    "collector.total_frames=192",
    "collector.init_random_frames=96",
    "evaluation.interval=96",
    "evaluation.episodes=1",
    "replay_buffer.batch_size=8",
    "replay_buffer.size=192",
    "network.num_cells=[8]",
    "logger.backends=[csv]",
    "logger.interval=96",
    "env.max_episode_steps=5",
    "optim.updates_per_batch=2",
    "compute.compile=false",
)
READ = (
    *(".hydra/overrides.yaml", "run.json", "manifest.json", "state.json", "state.safetensors"),
    ".csv",
)


class Bomb:
    """Makes a folder when it is unpickled."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple:
        return os.mkdir, (str(self.marker),)


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("pickles") / "run"
    run_here(pd_morl.main, *TINY, f"hydra.run.dir={folder}")
    return folder


def resume(run: Path) -> None:
    """As a user does: a mistake is one line, not a traceback."""
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("HYDRA_FULL_ERROR", raising=False)
        patch.setattr(sys, "argv", ["recipe.py", f"resume={run}", "collector.total_frames=288"])
        pd_morl.main()


def read_by_a_resume(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if str(path).endswith(READ))


def test_the_bomb_would_go_off(tmp_path):
    pickle.loads(pickle.dumps(Bomb(tmp_path / "marker")))
    assert (tmp_path / "marker").is_dir()


def test_all_kinds_of_files_are_tried(trained):
    files = [str(path) for path in read_by_a_resume(trained)]
    assert all(any(name.endswith(end) for name in files) for end in READ)
    assert len(files) > 20


@pytest.mark.parametrize("end", READ)
def test_a_pickle_is_refused_by_name_and_never_run(end, trained, tmp_path, capsys):
    for number, file in enumerate(
        path for path in read_by_a_resume(trained) if str(path).endswith(end)
    ):
        run = tmp_path / str(number)
        shutil.copytree(trained, run)
        marker, victim = tmp_path / f"marker {number}", run / file.relative_to(trained)
        victim.write_bytes(pickle.dumps(Bomb(marker)))
        with pytest.raises(SystemExit) as stop:
            resume(run)
        assert not marker.exists(), file
        assert stop.value.code in (1, 2), file
        *_, line = capsys.readouterr().err.splitlines()
        assert line.startswith("error: "), file
        # One without a manifest is no checkpoint.
        named = victim.parent if victim.name == "manifest.json" else victim
        assert f"{named} " in line or f"{named}:" in line, f"{file}: {line}"
        shutil.rmtree(run)
