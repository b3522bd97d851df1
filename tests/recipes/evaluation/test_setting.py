"""What a card says of the training: what it must not say is refused before anything is said or simulated."""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest

import recipes.evaluate
from envs import TURTLEBOT2, get_robot
from recipes.evaluation.setting import choose, demonstrator, scene_seed, trained_in
from recipes.results.systems import load_system

SHIPPED = Path(recipes.evaluate.__file__).parent / "policies" / "polished_seed0"
EXAMPLES = Path(recipes.evaluate.__file__).parents[1] / "examples"
MISTAKES = [
    ({"config": {"env": {"goal_radius": -1}}}, "config.env.goal_radius must be a number of metres"),
    ({"config": {"env": {"goal_radius": "0.3"}}}, "config.env.goal_radius must be .* got '0.3'"),
    ({"config": {"env": {"drive": "fly"}}}, "config.env.drive must be one of planar, wheels, got"),
    ({"config": {"env": {"drive": ["planar"]}}}, r"config.env.drive must be .*, got \['planar'\]"),
    ({"config": {"env": {"observe_human": "yes"}}}, "config.env: observe_human must be true or"),
    ({"config": {"env": "static"}}, "config.env must be an object, got 'static'"),
    ({"demonstrator": "circle"}, "demonstrator must be an object, got 'circle'"),
    ({"demonstrator": {"radius": "1"}}, "demonstrator.radius must be a number, got '1'"),
    ({"demonstrator": {"speed": True}}, "demonstrator.speed must be a number, got True"),
    ({"demonstrator": {"radius": -1.0}}, "demonstrator: radius must be positive"),
    ({"demonstrator": {"speed": 9.0}}, "demonstrator: .*speed"),
    ({"demonstrator": {"side": ["left"]}}, "demonstrator: side must be 'left' or 'right'"),
    ({"demonstrator": {"scaled": 1.0}}, "demonstrator has radius, side and speed, not 'scaled'"),
]


@pytest.mark.parametrize(("card", "message"), MISTAKES)
def test_a_card_that_says_something_else_is_refused_before_it_is_shown(card, message, capsys):
    with pytest.raises(ValueError, match=f"card: {message}") as error:
        choose(card)
    assert len(str(error.value).splitlines()) == 1
    assert capsys.readouterr().out == ""


def test_what_cards_say_is_taken():
    card = {
        "config": {"env": {"drive": "wheels", "goal_radius": 0.5, "observe_human": False}},
        "demonstrator": {"radius": 1.2, "side": "right", "speed": 0.4, "robot": "turtlebot2"},
    }
    setting = trained_in(card)
    assert (setting.drive, setting.goal_radius) == ("wheels", 0.5)
    assert setting.observed == {"observe_human": False}
    driver = demonstrator(card, get_robot("hsr"))
    assert (driver.radius, driver.side, driver.speed) == (1.2, "right", 0.4)
    assert demonstrator({}, get_robot("hsr")) is None


ANY = {"config": {"env": {"robot": "any"}}}


@pytest.mark.parametrize(
    "robot", ["turtlebot2", "hsr", EXAMPLES / "my_robot.yaml", {"radius": [0.2, 0.3]}]
)
def test_a_robot_within_the_ranges_of_the_training_is_nothing_to_note(robot, capsys):
    choose(ANY, robot=robot)
    assert "note" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("robot", "outside"),
    [
        ({"radius": 0.5}, "radius 0.5 m (trained: 0.12 to 0.35 m)"),
        ({"radius": 0.2, "max_speed": 1.5}, "max_speed 1.5 m/s (trained: 0.25 to 1 m/s)"),
        ({"radius": 0.2, "lidar_range": 2.0}, "lidar_range 2 m (trained: 3 to 10 m)"),
        (
            {"radius": 0.2, "lidar_offset": -0.15},
            "lidar_offset -0.75 of the radius (trained: -0.5 to 0.8 of the radius)",
        ),
        ({"radius": [0.1, 0.3]}, "radius 0.1 to 0.3 m (trained: 0.12 to 0.35 m)"),
        (
            {"radius": 0.5, "max_speed": 1.5},
            "radius 0.5 m (trained: 0.12 to 0.35 m), max_speed 1.5 m/s (trained: 0.25 to 1 m/s)",
        ),
    ],
)
def test_a_robot_outside_of_the_ranges_is_told_which_number_is(robot, outside, capsys):
    choose(ANY, robot={"name": "mine", **robot})
    (note,) = [line for line in capsys.readouterr().out.splitlines() if "note" in line]
    assert note == (
        f"note: --robot mine is outside of what the policy was trained with: {outside}: this "
        "measures how well it transfers."
    )


def test_the_robot_that_drives_is_named(capsys):
    assert choose(ANY, one_robot=True).robot == TURTLEBOT2
    assert "robot turtlebot2, drive" in capsys.readouterr().out
    choose(ANY, robot={"name": "mine", "radius": [0.2, 0.3]}, one_robot=True)
    assert "robot turtlebot2, drive" in capsys.readouterr().out
    choose(ANY)
    assert "robot any (another in every episode), drive" in capsys.readouterr().out


def test_another_robot_than_the_one_of_the_training_is_noted(capsys):
    choose({}, robot="hsr")
    assert "is not what the policy was trained with, turtlebot2" in capsys.readouterr().out


def policy_with(tmp_path: Path, **changes: Any) -> Path:
    folder = tmp_path / "policy"
    shutil.copytree(SHIPPED, folder)
    file = folder / "policy.json"
    content = json.loads(file.read_text())
    content["card"].update(changes)
    file.write_text(json.dumps(content))
    return folder


@pytest.mark.parametrize(("changes", "message"), MISTAKES[:1] + MISTAKES[6:9])
def test_evaluate_says_it_in_one_line(changes, message, tmp_path, monkeypatch, capsys):
    folder = policy_with(tmp_path, **changes)
    monkeypatch.setattr(sys, "argv", ["evaluate.py", "--policy", str(folder), "--episodes", "1"])
    with pytest.raises(SystemExit) as stop:
        recipes.evaluate.main()
    assert stop.value.code == 2
    printed = capsys.readouterr()
    assert printed.out == "" and len(printed.err.splitlines()) == 1 and "card: " in printed.err


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"demonstrator": "circle"}, "demonstrator must be an object"),
        ({"start": "start"}, "start must be an object, got 'start'"),
        ({"start": {"start": ["start"]}}, "start must be an object"),
        ({"start": {"config": [1]}}, r"config must be an object, got \[1\]"),
        ({"start": {"config": {"seed": [1]}}}, r"config.seed must be a whole number, got \[1\]"),
    ],
)
def test_a_system_whose_card_says_something_else_is_refused(changes, message, tmp_path):
    with pytest.raises(ValueError, match=f"card: {message}"):
        load_system(f"OUR={policy_with(tmp_path, **changes)}")


def test_a_seed_in_other_digits_is_one_line():
    with pytest.raises(
        argparse.ArgumentTypeError, match="must be a whole number from 7 to 9999, got"
    ):
        scene_seed("\u00b2")
