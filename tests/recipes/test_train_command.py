"""The command line of recipes.train: what it refuses before the first stage, and how it goes on."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

import recipes.stages
import recipes.train
from recipes.record import Record, lock


@pytest.fixture
def stages(tmp_path, monkeypatch) -> list[tuple[str, list[str]]]:
    """What would be run, by name; the stages leave what the next need."""
    calls = []

    def run(name: str, command: list[str]) -> float:
        calls.append((name, command))
        folder = Path(command[1].partition("=")[2].strip("'"))
        if name in ("PD-MORL", "MO-PPO"):
            save_policy(folder)
        return 1.0

    monkeypatch.setattr(recipes.stages, "run", run)
    monkeypatch.chdir(tmp_path)
    return calls


def save_policy(folder: Path) -> None:
    policy = folder / "policies" / "000000001"
    policy.mkdir(parents=True)
    (policy / "policy.json").write_text(json.dumps({"card": {"score": 1.0}}))


def train(*arguments: object) -> int | str:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["train.py", *map(str, arguments)])
        try:
            recipes.train.main()
        except SystemExit as stop:
            return stop.code
    return 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["--drex", "reward_model.updates=0"],
            "--drex: reward_model.updates must be at least 1, got 0.",
        ),
        (
            ["--with-pd-morl", "--pd-morl", "seed=1", "optim.lr=-1"],
            "--pd-morl: optim.lr must be positive, got -1.",
        ),
        (
            ["--mo-ppo", "loss.clip_epsilon=-1"],
            "--mo-ppo: loss.clip_epsilon must be in (0, 1), got -1.",
        ),
        (
            ["--mo-ppo", "optim.lrr=1"],
            "--mo-ppo: there is no field optim.lrr: did you mean optim.lr?",
        ),
        (
            ["--with-pd-morl", "--pd-morl", "preset=fast"],
            "--pd-morl: In 'config': Could not find 'preset/fast'",
        ),
        (
            ["--with-pd-morl", "--pd-morl", "demonstrations.dataset=x.safetensors"],
            "there is no such file.",
        ),
        (
            ["--with-pd-morl", "--pd-morl", "env.observe_human=false"],
            "env.observe_human must be the same for --drex and --pd-morl, got True and False.",
        ),
        (
            ["--drex", "env.observe_human=false"],
            "env.observe_human must be the same for --drex and --mo-ppo, got False and True.",
        ),
        (
            ["--pd-morl", "seed=1"],
            "--pd-morl changes nothing without PD-MORL: give --with-pd-morl, too.",
        ),
        (["--with-pd-morl", "--without-mo-ppo"], "not allowed with argument"),
        (["--with-pd-morl", "--paper"], "not allowed with argument"),
        (["--paper", "--mo-ppo", "seed=1"], "PD-MORL alone leaves nothing that --mo-ppo"),
        (["--mo-ppo", "preset=fast"], "--mo-ppo: In 'config': Could not find 'preset/fast'"),
        (["--mo-ppo", "preset=quick"], "--mo-ppo: "),
        (
            ["--with-pd-morl", "--pd-morl", "hydra.run.dir=x"],
            "--pd-morl hydra.run.dir=x: the stages run in the folder of --output, leave it out.",
        ),
        (
            ["--mo-ppo", "+resume=x"],
            "--mo-ppo +resume=x: the stages run in the folder of --output, leave it out.",
        ),
        (
            ["--episodes", "0"],
            "argument --episodes: must be a whole number from 1 to 100000, got '0'",
        ),
        (["--episodes", "999999999"], "got '999999999'"),
        (["--seed", "-1"], "unrecognized arguments: --seed -1"),
        (["--resume", "nowhere"], "argument --resume: must be a folder, 'nowhere' does not exist"),
        (["--resume", "."], "stages.json not found"),
        (["--resume", ".", "--output", "x"], "not allowed with argument"),
        (["--without-mo-ppo", "--mo-ppo", "seed=1"], "PD-MORL alone leaves nothing that"),
        (["--output", "/proc/x"], "--output /proc/x: /proc cannot be written"),
    ],
)
def test_a_mistake_is_one_line_before_the_first_stage(arguments, message, stages, tmp_path, capsys):
    assert train(*arguments) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("train.py: error: ") and message in line
    assert stages == []
    assert list(tmp_path.iterdir()) == []


def test_a_training_needs_no_pd_morl(stages, tmp_path):
    output = tmp_path / "run"
    given = ("--drex", "seed=2", "--mo-ppo", "seed=3")
    assert train("--output", output, *given) == 0
    assert [name for name, _ in stages] == ["D-REX", "MO-PPO", "evaluation"]
    drex, ppo, evaluation = (command for _, command in stages)
    # R and the drives that are cloned are of one run, whose presets are the ones that fit.
    assert "preset=tracked" in drex and drex[-1] == "seed=2"
    assert {
        "preset=nothing",
        f"demonstrations.reward_model={output}/drex/reward_model",
        f"demonstrations.dataset={output}/drex/tracked.safetensors",
        "seed=3",
    } <= set(ppo)
    assert not any(one.startswith("policy=") for one in ppo)
    assert f"{output}/mo_ppo/policies/000000001" in evaluation


@pytest.mark.parametrize(
    ("options", "names"),
    [
        (["--with-pd-morl"], ["D-REX", "PD-MORL", "MO-PPO", "evaluation"]),
        (["--with-pd-morl", "--pd-morl", "seed=1"], ["D-REX", "PD-MORL", "MO-PPO", "evaluation"]),
        (["--without-mo-ppo"], ["D-REX", "PD-MORL", "evaluation"]),
        (["--drex", "preset=quick"], ["D-REX", "MO-PPO", "evaluation"]),
    ],
)
def test_the_stages_are_those_that_are_asked_for(options, names, stages, tmp_path):
    assert train("--output", tmp_path / "run", *options) == 0
    assert [name for name, _ in stages] == names
    assert "preset=tracked" not in stages[0][1]


def test_the_paper_is_one_flag(stages, tmp_path):
    """No MO-PPO, demonstrations through the reward model alone."""
    output = tmp_path / "run"
    assert train("--output", output, "--paper", "--pd-morl", "seed=1") == 0
    assert [name for name, _ in stages] == ["D-REX", "PD-MORL", "evaluation"]
    drex, morl, evaluation = (command for _, command in stages)
    assert "preset=paper" in drex and {"preset=paper", "seed=1"} <= set(morl)
    assert not any("dataset" in one for one in morl)
    assert f"{output}/pd_morl/policies/000000001" in evaluation


def test_a_record_of_before_goes_on_with_pd_morl(stages, tmp_path):
    options = {"drex": [], "pd_morl": [], "mo_ppo": [], "without_mo_ppo": False, "episodes": 1}
    Record(tmp_path, options).save()
    assert train("--resume", tmp_path) == 0
    assert [name for name, _ in stages] == ["D-REX", "PD-MORL", "MO-PPO", "evaluation"]


def test_a_training_records_what_is_finished(stages, tmp_path):
    output = tmp_path / "ä (1),b=c"
    assert train("--output", output, "--drex", "seed=2", "--episodes", 5) == 0
    assert [name for name, _ in stages] == ["D-REX", "MO-PPO", "evaluation"]
    assert f"hydra.run.dir='{output}/drex'" in stages[0][1]
    record = Record.load(output)
    assert record.finished and all(map(record.is_finished, record.stages))
    assert record.options["drex"] == ["seed=2"] and record.options["episodes"] == 5
    assert record.stages["MO-PPO"]["command"] == stages[1][1]
    assert train("--resume", output) == 2


def test_trainings_without_a_name_have_a_folder_each(stages, tmp_path):
    assert [train() for _ in range(2)] == [0, 0]
    assert len(list((tmp_path / "runs" / "train").iterdir())) == 2


@pytest.mark.parametrize(
    ("number", "checkpoint"), [(0, False), (1, False), (1, True), (2, True), (3, False)]
)
def test_a_training_that_was_cut_short_goes_on(
    number, checkpoint, stages, tmp_path, monkeypatch, capsys
):
    names, run = ("D-REX", "PD-MORL", "MO-PPO", "evaluation"), recipes.stages.run

    def cut(name: str, command: list[str]) -> float:
        if name != names[number]:
            return run(name, command)
        if number < 3:
            folder = Path(command[1].partition("=")[2])
            folder.mkdir()
            if checkpoint:
                for file in ("checkpoints/1", ".hydra/overrides.yaml"):
                    (folder / file).parent.mkdir(exist_ok=True)
                    (folder / file).write_text("[]")
        raise SystemExit(130)

    monkeypatch.setattr(recipes.stages, "run", cut)
    output = tmp_path / "run"
    assert train("--output", output, "--with-pd-morl", "--drex", "seed=2") == 130
    go_on = f"python -m recipes.train --resume {output}"
    assert capsys.readouterr().err == f"stopped; go on with: {go_on}\n"
    assert train("--output", output) == 2
    assert f"{output} holds an unfinished training: go on with --resume" in capsys.readouterr().err

    stages.clear()
    monkeypatch.setattr(recipes.stages, "run", run)
    assert train("--resume", output) == 0
    assert [name for name, _ in stages] == list(names[number:])
    overrides = stages[0][1][1:]
    if number < 3:
        cut_short = output / ("drex", "pd_morl", "mo_ppo")[number]
        assert (f"resume={cut_short}" in overrides) == checkpoint
    if number == 0:
        assert "seed=2" in overrides
        # What comes after takes what has been made now.
        drex = Record.load(output).folder_of("D-REX")
        assert f"demonstrations.reward_model={drex}/reward_model" in stages[1][1]
    assert Record.load(output).finished


def test_a_stage_that_fails_says_how_to_go_on(stages, tmp_path, monkeypatch):
    def fail(name: str, command: list[str]) -> float:
        raise SystemExit(f"{name} failed with exit code 1; see above.")

    monkeypatch.setattr(recipes.stages, "run", fail)
    assert train("--output", tmp_path / "run") == (
        "D-REX failed with exit code 1; see above. When that is put right go on with: "
        f"python -m recipes.train --resume {tmp_path / 'run'}"
    )


def test_a_stage_that_leaves_no_score_is_one_line(stages, tmp_path, monkeypatch):
    """Of a policy that somebody has changed."""
    run = recipes.stages.run

    def spoil(name: str, command: list[str]) -> float:
        seconds = run(name, command)
        if name == "PD-MORL":
            (tmp_path / "run/pd_morl/policies/000000001/policy.json").write_text("{}")
        return seconds

    monkeypatch.setattr(recipes.stages, "run", spoil)
    line = train("--output", tmp_path / "run", "--with-pd-morl")
    assert "policy.json does not say the score of the policy" in line
    assert f"go on with: python -m recipes.train --resume {tmp_path / 'run'}" in line


def test_one_that_is_unfinished_is_offered_and_another_begins(stages, tmp_path, capsys):
    left = tmp_path / "runs" / "train" / "2026-01-31_12-00-00"
    left.mkdir(parents=True)
    Record(left, {}).save()
    assert train() == 0
    first = capsys.readouterr().out.splitlines()[0]
    assert first == (
        "runs/train/2026-01-31_12-00-00 is unfinished; to go on with it: "
        "python -m recipes.train --resume runs/train/2026-01-31_12-00-00"
    )
    assert len(list((tmp_path / "runs" / "train").iterdir())) == 2


def test_two_processes_do_not_go_on_with_the_same_training(stages, tmp_path, capsys):
    output = tmp_path / "run"
    output.mkdir()
    options = {"drex": [], "pd_morl": [], "mo_ppo": [], "without_mo_ppo": True, "episodes": 1}
    Record(output, options).save()
    with lock(output):
        assert train("--resume", output) == 2
    assert f"{output} is being trained by another process." in capsys.readouterr().err
    assert train("--resume", output, "--drex", "seed=1") == 2
    assert "give no others" in capsys.readouterr().err
    assert train("--resume", output) == 0
    assert [name for name, _ in stages] == ["D-REX", "PD-MORL", "evaluation"]
