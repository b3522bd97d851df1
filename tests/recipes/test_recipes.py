"""Recipes from the command line, as a user starts them, on settings that take seconds."""

from __future__ import annotations

import importlib.metadata
import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensordict import TensorDict
from torchrl.checkpoint import Checkpoint
from torchrl.data import Bounded

import recipes.evaluate
from envs import NavigationEnv
from recipes.training.checkpoint import SafeStateAdapter
from recipes.training.gradients import use_bfloat16
from tests._command import run
from torchrl_morl import PreferenceSpace
from torchrl_morl.deploy import load_policy, save_policy
from torchrl_morl.deploy.features import OBSERVATION_SIZE
from torchrl_morl.modules import make_actor

ROOT = Path(__file__).resolve().parents[2]
SPACE = PreferenceSpace(NavigationEnv.objectives, static={"core": 1.0})
CORNERS = (*SPACE.tunable, "balanced")
TINY = (
    "collector.total_frames=960",
    "collector.init_random_frames=480",
    "collector.frames_per_batch=96",
    "evaluation.interval=576",
    "evaluation.episodes=3",
    "replay_buffer.batch_size=16",
    "replay_buffer.size=960",
    "network.num_cells=[16,16]",
    "logger.interval=96",
    "env.max_episode_steps=30",
    "optim.updates_per_batch=4",
    "compute.compile=false",
    "compute.bfloat16=false",
)


# --- recipes.pd_morl


def train(folder: Path, *overrides: str) -> subprocess.CompletedProcess[str]:
    return run("recipes.pd_morl.pd_morl", *TINY, *overrides, f"hydra.run.dir={folder}")


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> tuple[Path, subprocess.CompletedProcess[str]]:
    folder = tmp_path_factory.mktemp("pd_morl") / "run"
    result = train(folder)
    assert result.returncode == 0, result.stderr
    return folder, result


def test_training_says_what_it_did(trained):
    folder, result = trained
    for name in ("after 576 steps", "after 960 steps", *CORNERS, "success", "step/s", "updates/s"):
        assert name in result.stdout + result.stderr
    assert f"last policy: {folder / 'policies' / '000000960'}" in result.stdout
    assert "Warning" not in result.stderr


def test_run_folder_tells_how_to_repeat_the_run(trained):
    folder, _ = trained
    config = (folder / ".hydra" / "config.yaml").read_text()
    assert "total_frames: 960" in config  # overridden
    assert "polyak: 0.995" in config  # default
    assert "${" not in config
    info = json.loads((folder / "run.json").read_text())
    # Of the package: that of the module may have a build behind it.
    assert info["versions"]["torch"] == importlib.metadata.version("torch")
    assert {"torchrl", "tensordict", "mujoco", "numpy"} < set(info["versions"])
    if (ROOT / ".git").exists():
        assert len(info["git"]["commit"]) == 40
        changed = info["git"]["uncommitted_changes"]
        assert changed == (folder / "uncommitted.diff").exists()


TRAINING = (
    "loss_actor",
    "loss_qvalue",
    "saturated_fraction",
    "angle",
    "grad_norm_qvalue",
    "grad_norm_actor",
    "updates",
    *(f"q_scale/{name}" for name in SPACE.objectives),
)
EVALUATION = (
    "score",
    "success",
    *(f"{column}/{name}" for column in ("success", "collision", "timeout") for name in CORNERS),
)


def test_both_loggers_hold_every_metric(trained):
    folder, _ = trained
    events = EventAccumulator(str(folder / "log_tensorboard"))
    events.Reload()
    for name, steps in (
        *((f"train/{name}", [576, 672, 768, 864, 960]) for name in TRAINING),
        *((f"eval/{name}", [576, 960]) for name in EVALUATION),
    ):
        scalars = events.Scalars(name)
        assert [scalar.step for scalar in scalars] == steps, name
        rows = (folder / "log_csv" / "scalars" / f"{name}.csv").read_text().split()
        pairs = [row.split(",") for row in rows]
        assert [int(float(step)) for step, _ in pairs] == steps, name
        values = [float(value) for _, value in pairs]
        assert values == pytest.approx([scalar.value for scalar in scalars], rel=1e-5), name
        assert all(value == value for value in values), name
    assert [scalar.value for scalar in events.Scalars("train/updates")] == [4, 8, 12, 16, 20]


def test_best_policy_is_named_at_the_end(trained):
    folder, result = trained
    scores = {
        path: json.loads((path / "policy.json").read_text())["card"]["score"]
        for path in (folder / "policies").iterdir()
    }
    best = max(scores, key=scores.get)
    assert f"best policy: {best} (score {scores[best]:.2f})" in result.stdout


def test_last_checkpoint_can_be_loaded(trained):
    folder, _ = trained
    (last,) = (folder / "checkpoints").iterdir()
    assert last.name.endswith("960")

    # The checkpoint holds the averaged actor that is in the policy's file, beside the latest one.
    class Sink:
        def load_state_dict(self, state):
            self.state = state

        def state_dict(self):
            return {}

    loss, averaged, count = Sink(), Sink(), Sink()
    checkpoint = Checkpoint()
    for name, sink in (("loss", loss), ("averaged", averaged), ("count", count)):
        checkpoint.register(name, sink, adapter=SafeStateAdapter())
    result = checkpoint.load(last, strict="warn")
    assert not result.missing and not result.incompatible
    policy = load_policy(folder / "policies" / "000000960")
    assert count.state["frames"] == 960 and count.state["updates"] == 20
    assert count.state["score"] == policy.card["score"]
    for name, value in policy.actor.state_dict().items():
        assert torch.equal(averaged.state[f"module.{name}"], value)
    weight = policy.actor.state_dict()["module.0.module.0.weight"]
    latest = [value for value in _tensors(loss.state) if value.shape == weight.shape]
    assert latest
    assert not any(torch.equal(value, weight) for value in latest)


def _tensors(state: dict) -> list[torch.Tensor]:
    flat = [_tensors(v) if isinstance(v, dict) else [v] for v in state.values()]
    return [v for values in flat for v in values if isinstance(v, torch.Tensor)]


def test_policies_can_be_loaded(trained):
    folder, _ = trained
    names = sorted(path.name for path in (folder / "policies").iterdir())
    assert names == ["000000576", "000000960"]
    for name in names:
        policy = load_policy(folder / "policies" / name)
        assert policy.preference_space == SPACE
        assert policy.card["config"]["network"]["num_cells"] == [16, 16]
        assert policy.card["evaluation"]["preferences"] == list(CORNERS)
        data = TensorDict(observation=torch.zeros(2, OBSERVATION_SIZE), preference=torch.eye(2))
        assert policy.actor(data)["action"].abs().max() <= 1


def test_one_seed_gives_one_policy(trained, tmp_path):
    folder, _ = trained
    assert train(tmp_path).returncode == 0
    names = ("000000576", "000000960")
    first, second = (
        [(path / "policies" / name / "policy.safetensors").read_bytes() for name in names]
        for path in (folder, tmp_path)
    )
    assert first == second
    assert first[0] != first[1]


def test_compiled_gradients_train(trained, tmp_path):
    # As on a machine that multiplies bfloat16; any can.
    result = train(
        tmp_path / "run",
        "compute.compile=true",
        "compute.bfloat16=true",
        "collector.total_frames=672",
    )
    assert result.returncode == 0, result.stderr
    assert "recompile_limit" not in result.stderr
    assert "warning: " not in result.stderr  # those of the libraries among themselves


@pytest.mark.gpu
@pytest.mark.parametrize(
    "compute",
    [
        ("compute.compile=false",),
        ("compute.compile=true",),
        ("compute.compile=true", "compute.compile_mode=reduce-overhead"),
    ],
    ids=["eager", "compiled", "graphs"],
)
def test_trains_on_a_gpu(compute, tmp_path):
    result = train(tmp_path / "run", "device=cuda", *compute)
    assert result.returncode == 0, result.stderr
    policy = load_policy(tmp_path / "run" / "policies" / "000000960")
    observation = torch.zeros(1, OBSERVATION_SIZE)
    data = TensorDict(observation=observation, preference=SPACE.corners()[:1], batch_size=1)
    assert policy.actor(data)["action"].isfinite().all()


@pytest.mark.parametrize("given", [True, False])
def test_bfloat16_as_asked_for(given):
    assert use_bfloat16(given, torch.device("cpu")) is given


@pytest.mark.parametrize("feature", ["avx512_bf16", "amx_bf16", None])
def test_bfloat16_where_the_processor_has_it(feature, monkeypatch):
    found = dict.fromkeys(("avx512_bf16", "amx_bf16"), False) | {feature: True}
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: found)
    assert use_bfloat16(None, torch.device("cpu")) is (feature is not None)


def test_training_that_ends_between_two_evaluations_keeps_its_policy(tmp_path):
    result = train(tmp_path, "evaluation.interval=100000", "collector.total_frames=576")
    assert result.returncode == 0, result.stderr
    assert (tmp_path / "policies" / "000000576" / "policy.safetensors").is_file()


def test_training_without_an_update_is_refused(tmp_path):
    result = train(tmp_path / "run", "collector.total_frames=96")
    assert result.returncode == 2
    assert "greater than collector.init_random_frames, 480, got 96" in result.stderr
    assert not (tmp_path / "run").exists()


def test_run_folder_that_holds_policies_is_refused_before_the_training(trained):
    folder, _ = trained
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    kept = [path for path in files if ".hydra" not in path.parts and path.suffix != ".log"]
    before = [path.read_bytes() for path in kept]
    result = train(folder)
    assert result.returncode != 0
    message = f"{folder / 'policies'} exists and is not overwritten: choose another hydra.run.dir"
    assert message in result.stderr
    assert "step/s" not in result.stderr
    assert sorted(path for path in folder.rglob("*") if path.is_file()) == files
    assert [path.read_bytes() for path in kept] == before


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("env.scene=nowhere", "Unknown scene 'nowhere'"),
        ("env.num_envs=0", "num_envs must be at least 1, got 0"),
        ("preference.relabel_ratio=2", "ratio must be in [0, 1], got 2"),
    ],
)
def test_bad_override_fails_before_anything_is_written(override, message, tmp_path):
    result = train(tmp_path / "run", override)
    assert result.returncode != 0
    assert message in result.stderr
    # Hydra itself notes the overrides, before it starts the recipe.
    written = {path.name for path in (tmp_path / "run").glob("*")}
    assert written <= {".hydra", "pd_morl.log"}


# --- recipes.evaluate


@pytest.fixture(scope="module")
def policy(tmp_path_factory) -> Path:
    torch.manual_seed(0)
    actor = make_actor(Bounded(-1.0, 1.0, (2,)), in_features=OBSERVATION_SIZE + 2, num_cells=(8,))
    return save_policy(
        tmp_path_factory.mktemp("policies") / "tiny",
        actor,
        preference_space=SPACE,
        card={},
    )


def evaluate(monkeypatch, *args: object) -> None:
    """In this process, which has paid for its imports."""
    monkeypatch.setattr(sys, "argv", ["evaluate.py", *map(str, args)])
    recipes.evaluate.main()


def check_table(text: str, setting: str) -> list[str]:
    """Returns the notes between the setting and the table."""
    lines = text.splitlines()
    assert lines[0] == setting
    begin = next(i for i, line in enumerate(lines) if line.split()[0] == "distance")
    header, *rows = lines[begin:]
    assert header.split()[:3] == ["distance", "efficiency", "success"]
    weights = [tuple(map(float, row.split()[:2])) for row in rows[:3]]
    assert weights == [(1.0, 0.0), (0.25, 0.75), (0.0, 1.0)]
    assert rows[3].startswith("all 12 episodes: success")
    for row in rows[:3]:  # success, collisions with the human and with boxes, timeouts
        shares = [float(part.split()[-1]) for part in row.split(" %")[:4]]
        assert sum(shares) == pytest.approx(100)
    return lines[1:begin]


PREFERENCES = ("--episodes", 4, "--preferences", "1,0", "0.25,0.75", "0,1")


def test_evaluation_prints_one_row_per_preference(policy):
    result = run("recipes.evaluate", "--policy", policy, "--scene", "moving_human", *PREFERENCES)
    assert result.returncode == 0, result.stderr
    setting = "scene moving_human, robot turtlebot2, drive planar, goal radius 0.3 m"
    assert check_table(result.stdout, setting) == []


def test_evaluation_of_another_scene_and_robot(policy, monkeypatch, capsys):
    scene = ("--scene", "corridor", "--robot", "hsr")
    evaluate(monkeypatch, "--policy", policy, *scene, *PREFERENCES)
    setting = "scene corridor, robot hsr, drive planar, goal radius 0.3 m"
    (note,) = check_table(capsys.readouterr().out, setting)
    assert note.startswith("note: --robot hsr is not what the policy was trained with, turtlebot2")


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["--preferences", "0.5,0.6"], "--preferences 0.5,0.6: preference = "),
        (["--preferences", "1,0", "1.5,-0.5"], "preference[1] = -0.5 for objective 'efficiency'"),
        (["--preferences", "1,0", "1"], "--preferences 1: preference must have shape [..., 2]"),
        (
            ["--preferences", "a,b"],
            "--preferences must be numbers, for distance,efficiency, with commas between, got 'a,b'",
        ),
        (["--preferences", "1,0", "--grid"], "not allowed with argument"),
        (["--scene", "nowhere"], "Unknown scene 'nowhere': choose one of ['ahead', "),
        (["--robot", "broom"], "Unknown robot 'broom': choose one of ['hsr', 'turtlebot2']"),
        (["--drive", "legs"], "argument --drive: invalid choice: 'legs'"),
        (["--episodes", "0"], "--episodes: must be a whole number from 1 to 100000, got '0'"),
        (["--dropout", "2"], "argument --dropout: must be a number from 0 to 1, got '2'"),
        (["--policy", "nowhere"], "policy.safetensors not found: a policy is a folder with"),
    ],
)
def test_evaluation_refuses_with_one_line(policy, args, message, monkeypatch, capsys):
    with pytest.raises(SystemExit) as stop:
        evaluate(monkeypatch, "--policy", policy, *args)
    assert stop.value.code == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    (line,) = printed.err.splitlines()
    assert line.startswith("evaluate.py: error: ")
    assert message in line


def test_preferences_are_read_in_the_order_of_the_tunable_objectives():
    assert torch.equal(
        recipes.evaluate.parse_preferences(["0.25,0.75", "1,0"], SPACE),
        torch.tensor([[0.25, 0.75], [1.0, 0.0]]),
    )


def test_evaluation_in_a_scene_that_cannot_be_solved_is_one_line(tmp_path):
    wall = tmp_path / "wall.yaml"
    wall.write_text(
        "start: [0, 0, 0]\ngoal: [8, 0]\nhuman: [4, 2]\nboxes:\n  - {at: [8, 0], size: [1, 1]}\n"
    )
    result = run("recipes.evaluate", "--scene", wall, "--episodes", 2)
    assert result.returncode == 2
    assert "Traceback" not in result.stderr
    assert "wall.yaml: goal must be farther from boxes[0]" in result.stderr.splitlines()[-1]
