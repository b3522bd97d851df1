"""A training that was killed where its record and what it has made do not agree."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import RewardScaling

import recipes.stages
import recipes.train
from recipes.record import Record
from recipes.training import command
from recipes.training.checkpoint import BufferState
from recipes.training.run_folder import is_over

OPTIONS = {"drex": [], "pd_morl": [], "mo_ppo": [], "without_mo_ppo": True, "episodes": 1}


def checkpoint(folder: Path, frames: int, total: object = 960) -> Path:
    (folder / "checkpoints" / f"checkpoint-{frames:012d}").mkdir(parents=True)
    (folder / ".hydra").mkdir(exist_ok=True)
    (folder / ".hydra" / "config.yaml").write_text(f"collector:\n  total_frames: {total}\n")
    (folder / ".hydra" / "overrides.yaml").write_text("[]")
    return folder


@pytest.fixture
def commands(monkeypatch) -> list[list[str]]:
    """What would be run."""
    found = []

    def run(name: str, given: list[str]) -> float:
        found.append(given)
        return 1.0

    monkeypatch.setattr(recipes.stages, "run", run)
    return found


def stage(folder: Path, name: str) -> Record:
    record = Record(folder, OPTIONS)
    record.begin(name, ["module"], name.lower().replace("-", "_"))
    recipes.stages.stage(
        record,
        name,
        record.stages[name]["folder"],
        lambda where: ["module", f"hydra.run.dir={where}"],
    )
    return record


def test_a_training_is_over_with_its_last_checkpoint(tmp_path):
    assert not is_over(tmp_path / "nowhere")
    assert not is_over(checkpoint(tmp_path / "under way", 768))
    assert is_over(checkpoint(tmp_path / "over", 960))
    assert is_over(checkpoint(tmp_path / "beyond", 1024))
    (tmp_path / "drex" / "reward_model").mkdir(parents=True)
    assert is_over(tmp_path / "drex")


def test_one_that_was_over_but_not_recorded_is_not_begun_again(commands, tmp_path):
    """Its recipe would refuse to go on: nothing is left to be done."""
    checkpoint(tmp_path / "pd_morl", 960)
    assert stage(tmp_path, "PD-MORL").is_finished("PD-MORL")
    assert commands == []


def test_one_that_was_under_way_goes_on(commands, tmp_path):
    folder = checkpoint(tmp_path / "pd_morl", 768)
    stage(tmp_path, "PD-MORL")
    assert commands == [["module", f"resume={folder}"]]


@pytest.mark.parametrize("file", ["config.yaml", "overrides.yaml", ".config.yaml.123"])
def test_one_that_had_made_nothing_begins_anew(file, commands, tmp_path):
    folder = tmp_path / "pd_morl"
    (folder / ".hydra").mkdir(parents=True)
    (folder / ".hydra" / file).write_text("")
    stage(tmp_path, "PD-MORL")
    assert commands == [["module", f"hydra.run.dir={folder}"]]
    assert not folder.exists()


def test_a_configuration_is_there_whole_or_not_at_all(tmp_path):
    """Hydra writes over that of a training that goes on: killed there, it could not go on again."""
    code = (
        "import os, sys; from pathlib import Path; from unittest import mock\n"
        f"from {command.__name__} import _save_config; from omegaconf import OmegaConf\n"
        "folder = Path(sys.argv[1]); cfg = OmegaConf.create(['a=1'])\n"
        "_save_config(cfg, 'overrides.yaml', folder)\n"
        "with mock.patch('os.fsync', lambda file: os.kill(os.getpid(), 9)):\n"
        "    _save_config(OmegaConf.create(['a=2']), 'overrides.yaml', folder)\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path)], cwd=Path(recipes.__file__).parents[1]
    )
    assert result.returncode == -9
    assert (tmp_path / "overrides.yaml").read_text() == "- a=1\n"


def test_a_buffer_that_holds_demonstrations_already_holds_what_was_saved_and_no_more():
    def buffer(*parts: torch.Tensor) -> TensorDictReplayBuffer:
        made = TensorDictReplayBuffer(
            storage=LazyTensorStorage(20),
            batch_size=4,
            transform=RewardScaling(0.0, 1.0, in_keys=["x"]),
        )
        for part in parts:
            made.extend(TensorDict({"x": part}, batch_size=[len(part)]))
        return made

    demonstrations = torch.arange(5.0)
    saved = buffer(demonstrations, torch.arange(5.0, 12.0))
    again = buffer(demonstrations)
    BufferState(again).load_state_dict(BufferState(saved).state_dict())
    for one in (saved, again):
        assert one[:]["x"].tolist() == [float(number) for number in range(12)]
        one.extend(TensorDict({"x": torch.arange(12.0, 22.0)}, batch_size=[10]))  # beyond its end
    assert len(again) == 20
    assert torch.equal(again[:]["x"], saved[:]["x"])
