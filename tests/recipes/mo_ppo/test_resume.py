"""MO-PPO goes on where it was, and reads nothing from a folder that could run."""

from __future__ import annotations

import json
import pickle
import shutil
import sys
from pathlib import Path

import pytest
import torch
from torchrl.checkpoint import Checkpoint, CheckpointRotation

from recipes.mo_ppo import mo_ppo
from recipes.training.checkpoint import SafeStateAdapter
from recipes.training.validation import ConfigurationError
from tests._mo_ppo import go_on, run, small_policy
from torchrl_morl.deploy import load_policy


@pytest.fixture(scope="module")
def polished(tmp_path_factory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("mo_ppo")
    start = small_policy(folder / "start")
    return start, run(folder / "run", start)


@pytest.fixture
def begun(polished, tmp_path) -> Path:
    """A run folder of its own, whose training is over."""
    return shutil.copytree(polished[1], tmp_path / "begun")


def refused(folder: Path, monkeypatch, capsys, *overrides: str) -> str:
    """The line that a user reads who cannot go on with a run."""
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    monkeypatch.setattr(sys, "argv", ["recipe.py", f"resume={folder}", *overrides])
    with pytest.raises(SystemExit) as stop:
        mo_ppo.main()
    assert stop.value.code in (1, 2)
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ")
    return line


class Sink:
    """Holds what was saved."""

    def load_state_dict(self, state):
        self.state = state

    def state_dict(self):
        return {}


def saved_state(checkpoint: Path, name: str) -> dict:
    sink = Sink()
    reader = Checkpoint()
    reader.register(name, sink, adapter=SafeStateAdapter())
    assert not reader.load(checkpoint, strict="warn").incompatible
    return sink.state


def test_goes_on_from_the_last_checkpoint(begun):
    before = {path: path.read_bytes() for path in begun.glob("policies/*/*")}
    # The actor waits for the critic: what is saved at the end is what was loaded.
    go_on(begun, "collector.total_frames=192", "optim.critic_batches=100")
    names = ["000000064", "000000128", "000000192"]
    assert sorted(path.name for path in (begun / "policies").iterdir()) == names
    assert before == {path: path.read_bytes() for path in before}
    weights = [load_policy(begun / "policies" / name).actor.state_dict() for name in names]
    for name, value in weights[2].items():
        torch.testing.assert_close(value, weights[1][name], rtol=0, atol=0)
    assert any(not torch.equal(value, weights[0][name]) for name, value in weights[2].items())
    # What was given at the start still counts.
    config = load_policy(begun / "policies" / "000000192").card["config"]
    assert (config["env"]["num_envs"], config["optim"]["batch_size"]) == (4, 16)
    # And so does the critic's optimizer: 2 updates a pass over a batch of 32 frames. Of the first run
    # one batch in three passes and three in one; of the second, whose critic is alone, two in three.
    (last,) = (begun / "checkpoints").iterdir()
    assert saved_state(last, "count") == {"frames": 192, "begin": 192}
    steps = {int(entry["step"]) for entry in saved_state(last, "critic")["state"].values()}
    assert steps == {2 * (3 + 3) + 2 * (3 + 3)}


def test_checkpoints_say_where_the_schedule_begins(polished, tmp_path, monkeypatch):
    start, _ = polished
    saved, save = [], CheckpointRotation.save

    def record(self, *args, **kwargs):
        path = save(self, *args, **kwargs)
        count = saved_state(path, "count")
        saved.append((count["frames"], count["begin"]))
        return path

    monkeypatch.setattr(CheckpointRotation, "save", record)
    folder = run(tmp_path / "run", start)
    # Cut short anywhere it goes on with its own schedule; what follows its end begins another.
    assert saved == [(64, 0), (128, 128)]
    go_on(folder, "collector.total_frames=256")
    assert saved[2:] == [(192, 128), (256, 256)]


@pytest.mark.parametrize("count", [{"frames": 128}, {"frames": 128, "begin": "soon"}])
def test_refuses_a_checkpoint_that_does_not_say_where_it_stands(begun, count, monkeypatch, capsys):
    (state,) = begun.glob("checkpoints/*/components/*-count/state.json")
    state.write_text(json.dumps({"dict": list(count.items())}))
    line = refused(begun, monkeypatch, capsys, "collector.total_frames=192")
    assert "does not fit this training" in line
    assert f"it must say frames, begin, it says {count}." in line
    assert not (begun / "policies" / "000000192").exists()


class Bomb:
    """Leaves a file behind when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


READ = (
    ".hydra/overrides.yaml",
    "run.json",
    "log_csv/scalars/train/failed.csv",
    "checkpoints/*/manifest.json",
    *(
        f"checkpoints/*/components/*-{name}/state.{ending}"
        for name in (
            *("loss", "advantage", "averaged", "actor", "critic"),
            *("collector", "count", "generators"),
        )
        for ending in ("json", "safetensors")
    ),
)
"""What a resume reads of a run folder."""


@pytest.mark.parametrize("name", READ)
def test_a_pickle_in_a_run_is_not_opened(begun, name, tmp_path, monkeypatch, capsys):
    (file,) = begun.glob(name)
    trace = tmp_path / "trace"
    for plant in (
        lambda: file.write_bytes(pickle.dumps(Bomb(trace))),
        lambda: torch.save({"state": Bomb(trace)}, file),
        lambda: file.write_text(f"!!python/object/apply:pathlib.Path.touch [{trace}]\n"),
    ):
        plant()
        line = refused(begun, monkeypatch, capsys, "collector.total_frames=192")
        assert str(begun) in line
        assert not trace.exists()
    assert not (begun / "policies" / "000000192").exists()


def test_a_checkpoint_in_a_format_with_pickles_is_not_opened(begun, tmp_path, monkeypatch, capsys):
    trace = tmp_path / "trace"
    (manifest,) = begun.glob("checkpoints/*/manifest.json")
    content = json.loads(manifest.read_text())
    for record in content["components"].values():
        record.update(adapter="torchrl.state_dict", files=["state.pt"])
        torch.save({"state": Bomb(trace)}, manifest.parent / record["path"] / "state.pt")
    manifest.write_text(json.dumps(content))
    line = refused(begun, monkeypatch, capsys, "collector.total_frames=192")
    assert "does not fit this training" in line
    assert not trace.exists()


def test_all_that_a_checkpoint_holds_is_safe_to_read(begun):
    files = {path.name for path in begun.glob("checkpoints/*/components/*/*")}
    assert files == {"state.json", "state.safetensors"}
    components = {path.name.split("-")[1] for path in begun.glob("checkpoints/*/components/*")}
    assert components == {
        name.split("*-")[1].split("/")[0] for name in READ if "components" in name
    }


def test_refuses_to_resume_what_is_done(begun):
    files = {path: path.read_bytes() for path in begun.rglob("*") if path.is_file()}
    with pytest.raises(ConfigurationError, match="has seen 128 frames already"):
        go_on(begun)
    after = {path: path.read_bytes() for path in begun.rglob("*") if path.is_file()}
    changed = {path.relative_to(begun).parts[0] for path in after if after[path] != files.get(path)}
    assert changed <= {".hydra"} and after.keys() == files.keys()


def test_refuses_to_resume_in_another_folder(polished, tmp_path):
    start, folder = polished
    with pytest.raises(ValueError, match=r"goes on in its own folder: leave out hydra\.run\.dir"):
        run(tmp_path / "run", start, f"resume={folder}", "collector.total_frames=192")
    assert not (tmp_path / "run").exists()


ROOM = "start: [0, 0, 0]\ngoal: [{goal}, 0]\nhuman: [3, 5]\n"


def test_goes_on_with_the_scene_and_the_robot_that_it_began_with(polished, tmp_path):
    start, _ = polished
    room, robot = tmp_path / "room.yaml", tmp_path / "my robot.yaml"
    room.write_text(ROOM.format(goal=8))
    robot.write_text("radius: 0.2\n")
    files = (f"env.scene={room}", f"env.robot={robot}")
    folder = run(tmp_path / "run", start, *files, "collector.total_frames=64")
    room.write_text(ROOM.format(goal=4))  # edited since
    robot.unlink()  # and moved away

    go_on(folder, "collector.total_frames=128")
    first, second = (env_of(folder, name) for name in ("000000064", "000000128"))
    assert first["scene"]["goal"] == [8, 0] and first["scene"]["name"] == "room"
    assert first["robot"] == {"name": "my robot", "radius": 0.2}
    assert (second["scene"], second["robot"]) == (first["scene"], first["robot"])

    # Once more, and what is given now counts.
    go_on(folder, "collector.total_frames=192", f"env.scene={room}")
    third = env_of(folder, "000000192")
    assert third["scene"]["goal"] == [4, 0] and third["robot"] == first["robot"]
    room.unlink()
    go_on(folder, "collector.total_frames=256")
    assert env_of(folder, "000000256")["scene"] == third["scene"]


def env_of(folder: Path, name: str) -> dict:
    return load_policy(folder / "policies" / name).card["config"]["env"]
