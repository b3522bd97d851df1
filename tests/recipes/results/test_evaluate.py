"""Evaluations on disk: complete, resumable, never overwritten, and readable without us."""

from __future__ import annotations

import csv
import dataclasses
import json
import math
import sys
from functools import partial

import numpy as np
import pytest
import torch
from torchrl.data import Bounded

from envs import Faults
from envs.demonstrations import CircleDemonstrator
from recipes.evaluation.sweep import sweep
from recipes.results import evaluate as module
from recipes.results.conditions import CHANGES, SCENE_KINDS, condition, conditions
from recipes.results.episodes import OUTCOMES
from recipes.results.evaluate import evaluate
from recipes.results.files import read_evaluation, read_evaluations, write_evaluation
from recipes.results.systems import SPACE, Member, System, load_system, untrained
from tests._results import SCENES, fabricate
from torchrl_morl.deploy import save_policy
from torchrl_morl.deploy.features import OBSERVATION_SIZE
from torchrl_morl.modules import make_actor

CIRCLE = untrained("circle", lambda robot: CircleDemonstrator(robot=robot, scaled=True))
SHORT = partial(sweep, max_episode_steps=15)
OPTIONS = {"episodes": 6, "seed": 3, "progress": False}


def save(folder, seed: int, **card):
    """A policy that drives ahead at full speed."""
    torch.manual_seed(0)
    actor = make_actor(
        Bounded(-1.0, 1.0, (2,)), in_features=OBSERVATION_SIZE + SPACE.num_tunable, num_cells=(8,)
    )
    with torch.no_grad():
        actor[0].module[-1].bias.copy_(torch.tensor([5.0, 0.0]))
    return save_policy(
        folder,
        actor,
        preference_space=SPACE,
        card={"config": {"seed": seed}} | card,
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return evaluate(CIRCLE, "static", tmp_path_factory.mktemp("results"), **OPTIONS)


# --- the files


def test_episodes_as_anyone_reads_them(folder):
    with (folder / "episodes.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 6
    assert [row["scene_index"] for row in rows] == list("012345")
    for row in rows:
        assert (row["system"], row["condition"], row["scene"]) == ("circle", "static", "static")
        assert sum(int(row[name]) for name in OUTCOMES) == 1
        assert (row["time"] == "") == (row["success"] == "0")  # undefined is an empty field
        free = row["demonstration_free"] == "1"
        # It is the demonstrator: it gets through where the demonstrated way is free.
        assert free == (row["success"] == "1") == (float(row["frechet"]) < 1e-3)
        assert float(row["shortest_path"]) >= float(row["direct_distance"]) - 0.3 - 1e-6
        if free:
            assert 0 < float(row["spl"]) < 1 and 0 < float(row["stl"]) < 1
            assert float(row["path_length"]) > float(row["shortest_path"])
            assert float(row["min_clearance"]) > 0
    assert {row["demonstration_free"] for row in rows} == {"0", "1"}


def test_summary_and_trajectories(folder):
    summary = json.loads((folder / "summary.json").read_text())
    assert (summary["episodes"], summary["scene_seed"], summary["num_preferences"]) == (6, 3, 1)
    evaluation = read_evaluation(folder)
    success = evaluation.values("success")
    assert success.shape == (1, 1, 6)
    rate = summary["rates"]["success"]
    assert rate["estimate"] == success.mean() and rate["n"] == 6
    assert rate["per_seed"] == [success.mean()]
    time = summary["metrics"]["time"][0]
    assert time["n"] == success.sum()
    assert time["estimate"] == pytest.approx(np.nanmean(evaluation.values("time")))
    assert time["low"] < time["estimate"] < time["high"]
    assert "median" in summary["metrics"]["min_time_to_collision"][0]
    with np.load(folder / "trajectories.npz", allow_pickle=False) as arrays:
        mask = arrays["mask"]
        steps = mask.sum(-1)[success == 1] - 1
        np.testing.assert_allclose(0.2 * steps, evaluation.values("time")[success == 1], rtol=1e-6)
        assert arrays["position"].shape == (*mask.shape, 2)
        assert arrays["demonstration"].shape[0] == arrays["boxes"].shape[0] == 6


def test_what_is_there_is_skipped_and_never_changed(folder):
    output = folder.parents[1]
    before = {path: path.stat().st_mtime_ns for path in folder.iterdir()}
    assert evaluate(CIRCLE, "static", output, **OPTIONS) is None
    with pytest.raises(FileExistsError, match=r"different episodes.*not overwritten"):
        evaluate(CIRCLE, "static", output, **OPTIONS | {"episodes": 7})
    other = dataclasses.replace(CIRCLE, members=(dataclasses.replace(CIRCLE.members[0], seed=1),))
    with pytest.raises(FileExistsError, match="different members"):
        evaluate(other, "static", output, **OPTIONS)
    assert {path: path.stat().st_mtime_ns for path in folder.iterdir()} == before


def test_what_fails_on_the_way_leaves_nothing(tmp_path):
    with pytest.raises(ValueError):
        write_evaluation(tmp_path / "a" / "static", {"x": [1, 2], "y": [1]}, {}, {})
    assert not list((tmp_path / "a").iterdir())


def test_preferences_and_training_seeds(tmp_path, monkeypatch, capsys):
    """From the command line: two trainings, six preferences."""
    monkeypatch.setattr(module, "sweep", SHORT)
    folders = [save(tmp_path / name, seed) for name, seed in (("a", 4), ("b", 9))]
    arguments = [f"OUR={folders[0]},{folders[1]}", "--output", str(tmp_path / "out")]
    arguments += ["--episodes", "2", "--steps", "2"]
    monkeypatch.setattr(sys, "argv", ["evaluate", *arguments])
    module.main()
    module.main()
    assert "OUR static: there already" in capsys.readouterr().out
    evaluation = read_evaluation(tmp_path / "out" / "OUR" / "static")
    assert evaluation.seeds == [4, 9]
    assert evaluation.values("success").shape == (2, 6, 2)
    np.testing.assert_array_equal(evaluation.preferences, SPACE.pairwise_grid(2).numpy())
    assert [evaluation.corner(name) for name in SPACE.tunable] == [3, 1, 0]
    assert evaluation.corner("comfort") is None
    # Both drive alike, and in the same scenes.
    distance = evaluation.values("min_human_distance")
    np.testing.assert_array_equal(distance[0], distance[1])


def test_scenes_that_differ_are_not_compared(tmp_path):
    fabricate(tmp_path, "OUR")
    fabricate(tmp_path, "NH", scene_seed=8)
    with pytest.raises(ValueError, match=r"scene_seed \(7 and 8\)|scene_seed \(8 and 7\)"):
        read_evaluations(tmp_path, "static")
    with pytest.raises(FileNotFoundError, match="--condition corridor"):
        read_evaluations(tmp_path, "corridor")


def test_files_that_are_incomplete_are_refused(tmp_path):
    folder = fabricate(tmp_path)
    lines = (folder / "episodes.csv").read_text().splitlines(keepends=True)
    (folder / "episodes.csv").write_text("".join(lines[:-1]))
    rows = 2 * 9 * SCENES
    with pytest.raises(ValueError, match=f"has {rows - 1} rows, summary.json says {rows}"):
        read_evaluation(folder)
    (folder / "summary.json").unlink()
    with pytest.raises(FileNotFoundError, match="no evaluation"):
        read_evaluation(folder)


# --- conditions


@pytest.mark.parametrize(
    "name", [*SCENE_KINDS, *CHANGES, "moving_human+faults", "corridor+hsr_wheels_faults"]
)
def test_conditions_by_name(name):
    arguments = condition(name)
    assert set(arguments) == {"scene", "robot", "drive", "faults"}
    assert arguments["scene"] == (
        name.split("+")[0] if name.split("+")[0] in SCENE_KINDS else "static"
    )


def test_all_faults_are_all():
    assert condition("hsr_wheels_faults") == {
        "scene": "static",
        "robot": "hsr",
        "drive": "wheels",
        "faults": Faults(range_noise=0.02, dropout=0.02, velocity_noise=0.05, latency=1),
    }
    assert condition("static")["faults"] is None


@pytest.mark.parametrize("name", ["", "rain", "static+rain", "hsr+static", "static+", "hsr+wheels"])
def test_unknown_conditions(name):
    with pytest.raises(ValueError, match="Unknown condition"):
        condition(name)


def test_all_is_every_condition_once():
    every = conditions(["hsr", "all", "static+latency_2"])
    assert every[0] == "hsr" and every[-1] == "static+latency_2"
    assert sorted(every) == sorted([*SCENE_KINDS, *CHANGES, "static+latency_2"])
    with pytest.raises(ValueError, match="Unknown condition 'rain': all, one of static"):
        conditions(["all", "rain"])


def test_nobody_is_at_no_distance(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "sweep", SHORT)
    folder = evaluate(CIRCLE, "nobody", tmp_path, episodes=2, seed=3, progress=False)
    assert np.isnan(read_evaluation(folder).values("min_human_distance")).all()


def test_other_robots_and_faults(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "sweep", SHORT)
    evaluation = read_evaluation(
        evaluate(CIRCLE, "hsr_wheels_faults", tmp_path, episodes=2, seed=3, progress=False)
    )
    assert np.isfinite(evaluation.values("frechet")).all()
    assert (evaluation.values("frechet") > 1e-3).all()  # the demonstration knows no faults


# --- systems


def test_systems_from_the_command_line(tmp_path):
    folder = save(tmp_path / "p", 5, demonstrator={"radius": 1.2, "robot": "turtlebot2"})
    system = load_system(f"OUR-NH={folder}")
    assert (system.name, [member.seed for member in system.members]) == ("OUR-NH", [5])
    assert system.demonstration == {"radius": 1.2}
    assert system.demonstrator("hsr").radius == 1.2
    assert not system.ignores_preference
    assert str(folder) in system.members[0].source and "sha256" in system.members[0].source
    core = load_system(f"CORE={save(tmp_path / 'core', 0, preference='ignored')}")
    assert core.ignores_preference
    straight = load_system("straight=reference:straight")
    assert straight.ignores_preference
    assert straight.members[0].actor("hsr").scaled


def test_polished_policies_are_told_apart_by_the_training_before(tmp_path):
    folders = [
        save(tmp_path / name, 5, start={"config": {}, "start": {"config": {"seed": seed}}})
        for name, seed in (("a", 1), ("b", 2))
    ]
    system = load_system("OUR=" + ",".join(map(str, folders)))
    assert [member.seed for member in system.members] == [1, 2]


def test_polishings_of_one_training_are_told_apart_by_their_own_seed(tmp_path):
    start = {"config": {"seed": 1}}
    folders = [save(tmp_path / f"p{seed}", seed, start=start) for seed in (5, 6)]
    system = load_system("OUR=" + ",".join(map(str, folders)))
    assert [member.seed for member in system.members] == [5, 6]
    with pytest.raises(ValueError, match="the same policy twice is no second training"):
        load_system(f"OUR={folders[0]},{folders[0]}")


def test_a_policy_without_the_human_is_driven_without_it(tmp_path):
    card = {"config": {"seed": 0, "env": {"observe_human": False, "num_envs": 8}}}
    system = load_system(f"NH={save(tmp_path / 'p', 0, **card)}")
    assert system.members[0].observed == {"observe_human": False}


@pytest.mark.parametrize("text", ["OUR", "OUR=", "=x", "OUR=a,,b", "O/R=reference:straight"])
def test_systems_written_wrongly(text, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises((ValueError, FileNotFoundError), match=r"Write NAME|A name is|not found"):
        load_system(text)


def test_members_that_do_not_belong_together(tmp_path):
    folder = save(tmp_path / "a", 1)
    with pytest.raises(ValueError, match="the same policy twice is no second training"):
        load_system(f"OUR={folder},{folder}")
    other = save(tmp_path / "b", 2, demonstrator={"radius": 2.0})
    with pytest.raises(ValueError, match="differ in more than their seed"):
        load_system(f"OUR={folder},{other}")
    with pytest.raises(ValueError, match="unknown reference"):
        load_system("x=reference:nobody")
    with pytest.raises(ValueError, match="needs members"):
        System("x", ())
    assert Member(0, lambda _: None, "x").observed == {}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["x=reference:straight", "--condition", "rain"], "Unknown condition 'rain'"),
        (
            ["x=reference:straight", "--episodes", "0"],
            "argument --episodes: must be a whole number from 1 to 100000, got '0'",
        ),
        (["x=nowhere"], "not found"),
        (["x=reference:straight", "x=reference:straight"], "x names two systems"),
    ],
)
def test_errors_come_before_any_work(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["evaluate", *arguments, "--output", str(tmp_path / "o")])
    with pytest.raises(SystemExit):
        module.main()
    assert message in capsys.readouterr().err
    assert not (tmp_path / "o").exists()


def test_an_output_that_is_a_file_is_named_before_any_work(tmp_path, monkeypatch, capsys):
    (tmp_path / "mine.csv").write_text("mine")
    monkeypatch.setattr(module, "sweep", lambda *_, **__: pytest.fail("it has begun"))
    arguments = ["x=reference:straight", "--output", str(tmp_path / "mine.csv")]
    monkeypatch.setattr(sys, "argv", ["evaluate", *arguments])
    with pytest.raises(SystemExit):
        module.main()
    assert "mine.csv is not a folder" in capsys.readouterr().err
    assert (tmp_path / "mine.csv").read_text() == "mine"


@pytest.mark.parametrize("content", ["[", "[]", "5", "[" * 100_000, "\udcff"])
def test_what_is_no_summary_is_another_evaluation(content, tmp_path):
    folder = tmp_path / CIRCLE.name / "static"
    folder.mkdir(parents=True)
    (folder / "summary.json").write_bytes(content.encode(errors="surrogateescape"))
    with pytest.raises(FileExistsError, match="holds another evaluation"):
        evaluate(CIRCLE, "static", tmp_path, **OPTIONS)


def test_numbers_survive_the_file(tmp_path):
    columns = {"time": [1 / 3, math.nan], "success": [True, False], "seed": [0, 0]}
    columns |= {"scene_index": [0, 1], "preference_index": [0, 0]}
    summary = {
        "system": "A",
        "condition": "static",
        "members": [{"seed": 0, "source": "made by hand"}],
        "episodes": 2,
        "scene_seed": 7,
        "edge_steps": 3,
        "ignores_preference": True,
        "objectives": ["demo"],
        "num_preferences": 1,
        "x": math.nan,
    }
    write_evaluation(tmp_path / "a", columns, summary, {})
    evaluation = read_evaluation(tmp_path / "a")
    np.testing.assert_allclose(evaluation.values("time")[0, 0], [1 / 3, math.nan], rtol=1e-8)
    np.testing.assert_array_equal(evaluation.values("success")[0, 0], [1, 0])
    assert evaluation.summary["x"] is None
    with pytest.raises(FileExistsError, match="not overwritten"):
        write_evaluation(tmp_path / "a", columns, summary, {})
    with pytest.raises(ValueError, match="no column 'speed'"):
        evaluation.values("speed")
