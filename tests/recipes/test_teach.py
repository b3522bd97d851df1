"""From recorded drives to a policy, in one command."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import recipes.stages
import recipes.teach as teach
from tests._bags import drive, write_bag
from tests._command import ROOT, run, run_here
from torchrl_morl.data import load_demonstrations
from torchrl_morl.deploy import load_policy

DRIVES = str(ROOT / "examples" / "drives_right.csv")
DREX = [
    "tracking.rollouts=20",
    "cloning.updates=50",
    "cloning.batch_size=64",
    "cloning.num_cells=[16]",
    "noise.levels=[0.0,0.2]",
    "noise.rollouts=4",
    "style_negatives.rollouts=24",
    "reward_model.updates=20",
    "reward_model.num_cells=[16]",
    "reward_model.batch_size=8",
    "diagnostics.rollouts=4",
    "env.num_threads=1",
    "torch_threads=1",
    "bfloat16=false",
]
MO_PPO = [
    "collector.total_frames=512",
    "collector.frames_per_batch=64",
    "evaluation.interval=256",
    "evaluation.episodes=3",
    "env.num_envs=8",
    "env.num_threads=1",
    "env.max_episode_steps=30",
    "network.num_cells=[16]",
    "optim.cloning_updates=20",
    "optim.batch_size=32",
    "optim.penalty_batch_size=16",
    "optim.critic_batches=1",
    "compute.bfloat16=false",
    "compute.torch_threads=1",
]


@pytest.fixture(scope="module")
def lesson(tmp_path_factory) -> tuple[Path, str]:
    folder = tmp_path_factory.mktemp("teach") / "lesson"
    arguments = [
        DRIVES,
        "--output",
        folder,
        "--episodes",
        4,
        "--drex",
        *DREX,
        "--mo-ppo",
        *MO_PPO,
    ]
    result = run("recipes.teach", *arguments)
    assert result.returncode == 0, result.stderr
    return folder, result.stdout


@pytest.mark.slow
def test_it_leaves_a_policy_with_the_objective_of_the_drives(lesson):
    folder, printed = lesson
    policies = sorted((folder / "mo_ppo" / "policies").iterdir())
    assert "demo" in load_policy(policies[-1]).preference_space.tunable
    assert f"try it: python -m recipes.demo --policy {folder}" in printed


@pytest.mark.slow
def test_it_compares_the_drives_with_those_of_every_objective(lesson):
    folder, printed = lesson
    numbers = json.loads((folder / "style.json").read_text())
    assert list(numbers) == ["shown", "demo", "distance", "efficiency"]
    assert numbers["shown"]["passes on the right"] == 1.0
    assert all(0 <= numbers[name]["success"] <= 1 for name in list(numbers)[1:])
    assert (folder / "style.png").stat().st_size > 10_000
    assert "passes on the right 100 %" in printed


@pytest.mark.slow
def test_what_was_not_learned_is_said(lesson):
    """A training of a second has learned nothing, or passes on the right by chance."""
    folder, printed = lesson
    learned = json.loads((folder / "style.json").read_text())["demo"]["passes on the right"]
    assert (learned < 0.9) == ("warning: at demonstration = 1 only" in printed)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--drex", "reward_model.updates=-3"], "--drex: reward_model.updates must be at least 1"),
        (["--mo-ppo", "bogus.field=1"], "--mo-ppo: there is no field bogus.field"),
        (["--mo-ppo", "hydra.run.dir=elsewhere"], "--mo-ppo hydra.run.dir=elsewhere: the stages"),
        (["--drex", "resume=elsewhere"], "--drex resume=elsewhere: the stages"),
        (["--drex", "env.robot=hsr"], "--drex env.robot=hsr: that is set by recipes.teach"),
        (["--mo-ppo", "+env.robot=hsr"], "--mo-ppo +env.robot=hsr: that is set by"),
        (["--mo-ppo", "demonstrations.dataset=null"], "that is set by recipes.teach"),
        (["--mo-ppo", "+hydra.callbacks.x=1"], "not Hydra's"),
        (["--output", "/proc/x"], "--output /proc/x: /proc cannot be written"),
        (["--robot", "broom"], "broom"),
        (["--episodes", "0"], "--episodes"),
    ],
)
def test_mistakes_are_found_before_anything_is_written(
    options, message, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit):
        run_here(teach.main, DRIVES, *options)
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert message in error
    assert list(tmp_path.iterdir()) == []


def test_a_folder_with_something_in_it_is_not_written_to(tmp_path, capsys):
    (tmp_path / "mine").write_text("mine")
    with pytest.raises(SystemExit):
        run_here(teach.main, DRIVES, "--output", str(tmp_path))
    assert "exists and is not overwritten: choose another" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


@pytest.fixture
def stages_run(monkeypatch, tmp_path) -> list[list[str]]:
    """What would be run; MO-PPO is cut short the first time, then leaves a policy."""
    calls: list[list[str]] = []

    def run(name: str, command: list[str]) -> float:
        calls.append(command)
        folder = tmp_path / "lesson" / command[0].split(".")[1]
        if name == "MO-PPO" and not folder.exists():
            (folder / ".hydra").mkdir(parents=True)
            (folder / ".hydra" / "overrides.yaml").write_text("[]")
            (folder / "checkpoints").mkdir()
            raise SystemExit(143)
        return 1.0

    monkeypatch.setattr(recipes.stages, "run", run)
    return calls


def test_a_lesson_that_was_cut_short_goes_on(stages_run, tmp_path, monkeypatch, capsys):
    lesson = tmp_path / "lesson"
    with pytest.raises(SystemExit) as stop:
        run_here(teach.main, DRIVES, "--output", str(lesson), "--drex", "seed=2")
    assert stop.value.code == 143
    go_on = f"python -m recipes.teach --resume {lesson}"
    assert capsys.readouterr().err == f"stopped; go on with: {go_on}\n"
    assert stages_run[0][-1] == "seed=2"

    with pytest.raises(SystemExit):
        run_here(teach.main, DRIVES, "--output", str(lesson))
    assert "holds an unfinished training: go on with --resume" in capsys.readouterr().err
    for given in (
        [DRIVES],
        ["--full"],
        ["--drex", "seed=3"],
        ["--robot", "hsr"],
        ["--episodes", "5"],
    ):
        with pytest.raises(SystemExit):
            run_here(teach.main, "--resume", str(lesson), *given)
        assert "give no others" in capsys.readouterr().err

    # Killed before the drives were kept: they are read again.
    (lesson / "demonstrations.safetensors").unlink()
    ended = []
    monkeypatch.setattr(teach, "final_policy", lambda folder: folder / "policy")
    monkeypatch.setattr(teach, "compare", lambda policy, dataset, **_: ended.append(policy))
    monkeypatch.setattr(teach, "draw", lambda *_: (_ for _ in ()).throw(OSError("disk\nfull")))
    with pytest.raises(SystemExit, match=rf"error: disk full When .* go on with: {go_on}"):
        run_here(teach.main, "--resume", str(lesson))
    assert (lesson / "demonstrations.safetensors").is_file()
    assert stages_run[2:] == [["recipes.mo_ppo.mo_ppo", f"resume={lesson / 'mo_ppo'}"]]
    assert ended == [lesson / "mo_ppo" / "policy"]


def test_a_bag_is_a_recording_too(stages_run, tmp_path):
    pytest.importorskip(
        "rosbags", reason="rosbags is not installed: pip install -c constraints.txt rosbags"
    )
    bag = write_bag(tmp_path / "bag", drive())
    with pytest.raises(SystemExit):
        run_here(teach.main, str(bag), "--output", str(tmp_path / "lesson"))
    data, about = load_demonstrations(tmp_path / "lesson" / "demonstrations.safetensors")
    assert (len(data), about["source"], about["accepted"]) == (1, "bag", ["bag"])


def test_what_is_no_lesson_is_not_gone_on_with(tmp_path, capsys):
    (tmp_path / "stages.json").write_text('{"options": {}, "stages": {}, "finished": false}')
    for given, message in (
        (["--resume", str(tmp_path)], "made by another command or version"),
        ([], "file must be given"),
    ):
        with pytest.raises(SystemExit) as stop:
            run_here(teach.main, *given)
        assert stop.value.code == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert message in line
