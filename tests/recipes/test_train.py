"""The training from nothing: its stages, and the policy it chooses."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

import recipes.stages
import recipes.train
from recipes.record import Record, lock


def save_scores(folder: Path, scores: list[float]) -> None:
    for index, score in enumerate(scores, start=1):
        policy = folder / "policies" / f"{index * 1000:09d}"
        policy.mkdir(parents=True)
        (policy / "policy.json").write_text(json.dumps({"card": {"score": score}}))


@pytest.mark.parametrize(
    ("scores", "best"),
    [
        ([9, 9, 9, 9, 9, 9, 9, 9, 1, 2], 10),
        ([9, 9, 9, 9, 9, 9, 9, 9, 2, 1], 9),
        ([3, 2, 1], 3),
        ([-4], 1),
    ],
)
def test_final_policy_is_the_best_of_the_last_fifth(scores, best, tmp_path):
    save_scores(tmp_path, scores)
    assert recipes.train.final_policy(tmp_path).name == f"{best * 1000:09d}"


def test_the_last_policy_is_that_of_the_end(tmp_path):
    save_scores(tmp_path, [9, 9, 9, 9, 9, 9, 9, 9, 2, 1])
    assert recipes.train.last_policy(tmp_path).name == "000010000"


def test_a_policy_that_was_never_finished_is_none(tmp_path):
    save_scores(tmp_path, [1, 2])
    (tmp_path / "policies" / ".000003000.1a2b3c").mkdir()
    assert recipes.train.final_policy(tmp_path).name == "000002000"


@pytest.mark.parametrize("folder_exists", [False, True])
def test_training_that_saved_no_policy_is_named(folder_exists, tmp_path):
    if folder_exists:
        (tmp_path / "policies").mkdir()
    with pytest.raises(SystemExit) as stop:
        recipes.train.final_policy(tmp_path)
    message = str(stop.value)
    assert f"{tmp_path / 'policies'} holds no policy" in message
    assert "Raise collector.total_frames." in message


@pytest.mark.parametrize("polish", [True, False])
def test_train_runs_its_stages_one_after_the_other(polish, tmp_path, monkeypatch, capsys):
    calls = []

    def run(name, command):
        calls.append((name, command))
        if name == "PD-MORL":
            save_scores(tmp_path / "run" / "pd_morl", [1, 2])
        if name == "MO-PPO":
            save_scores(tmp_path / "run" / "mo_ppo", [3])
        return 1.0

    monkeypatch.setattr(recipes.stages, "run", run)
    options = ["--output", str(tmp_path / "run"), "--episodes", "5", "--pd-morl", "seed=1"]
    options += ["--with-pd-morl", "--mo-ppo", "seed=3"] if polish else ["--without-mo-ppo"]
    monkeypatch.setattr(sys, "argv", ["train.py", *options, "--drex", "seed=2"])
    recipes.train.main()
    stages = ["D-REX", "PD-MORL", *(["MO-PPO"] if polish else []), "evaluation"]
    assert [name for name, _ in calls] == stages
    drex, morl, *ppo, evaluation = (command for _, command in calls)
    folder = tmp_path / "run"
    policy = str(folder / "pd_morl" / "policies" / "000002000")
    if polish:
        assert f"policy={policy}" in ppo[0]
        assert f"demonstrations.reward_model={folder / 'drex' / 'reward_model'}" in ppo[0]
        assert ppo[0][-1] == "seed=3"
        policy = str(folder / "mo_ppo" / "policies" / "000001000")
    assert drex[:2] == ["recipes.drex.drex", f"hydra.run.dir={folder / 'drex'}"]
    assert drex[2] in ("torch_threads=1", "torch_threads=2") and drex[3:] == ["seed=2"]
    assert f"demonstrations.reward_model={folder / 'drex' / 'reward_model'}" in morl
    assert f"demonstrations.dataset={folder / 'drex' / 'demonstrations.safetensors'}" in morl
    threads = [place for place, one in enumerate(morl) if one.startswith("compute.torch_threads=")]
    assert len(threads) == 1 and morl[threads[0]][-1] in "12"  # the user's come after
    assert morl[-1] == "seed=1"
    assert evaluation[1:5] == ["--policy", policy, "--episodes", "5"]
    assert f"python -m recipes.demo --policy {policy}" in capsys.readouterr().out


def test_train_refuses_a_folder_that_holds_something(tmp_path, monkeypatch, capsys):
    (tmp_path / "mine").write_text("")
    monkeypatch.setattr(recipes.stages, "run", lambda *_: pytest.fail("a stage has begun"))
    monkeypatch.setattr(sys, "argv", ["train.py", "--output", str(tmp_path)])
    with pytest.raises(SystemExit) as stop:
        recipes.train.main()
    assert stop.value.code == 2
    assert f"{tmp_path} exists and is not overwritten" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


@pytest.mark.parametrize("left", [[], [".lock"], [".lock", ".stages.json.123"]])
def test_train_begins_in_a_folder_that_one_killed_at_once_has_left(
    left, tmp_path, monkeypatch, capsys
):
    """Between the making of the folder and its record nothing is lost, and nothing is in the way."""
    for name in left:
        (tmp_path / name).write_text("")
    begun = []
    monkeypatch.setattr(recipes.train, "train", lambda record: begun.append(record))
    monkeypatch.setattr(sys, "argv", ["train.py", "--resume", str(tmp_path)])
    with pytest.raises(SystemExit):
        recipes.train.main()
    assert f"begin one in it with --output {tmp_path}" in capsys.readouterr().err
    monkeypatch.setattr(sys, "argv", ["train.py", "--output", str(tmp_path)])
    recipes.train.main()
    assert [record.folder for record in begun] == [tmp_path]
    assert Record.load(tmp_path).options["episodes"] == 100


@pytest.mark.parametrize("option", ["--output", "--resume"])
def test_train_leaves_a_folder_alone_that_another_process_has(
    option, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(recipes.train, "train", lambda record: pytest.fail("it has begun"))
    options = {"drex": [], "pd_morl": [], "mo_ppo": [], "without_mo_ppo": True, "episodes": 1}
    if option == "--resume":
        Record(tmp_path, options).save()
    before = sorted(path.name for path in tmp_path.iterdir())
    monkeypatch.setattr(sys, "argv", ["train.py", option, str(tmp_path)])
    with lock(tmp_path), pytest.raises(SystemExit):
        recipes.train.main()
    assert f"{tmp_path} is being trained by another process" in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([*before, ".lock"])


def test_train_stops_at_the_first_stage_that_fails():
    with pytest.raises(SystemExit, match="D-REX failed with exit code 2"):
        recipes.stages.run("D-REX", ["json.tool", "--no-such-option"])
