"""What the card of a trained policy keeps: it can be evaluated where the files of its training are not."""

from __future__ import annotations

import json

import torch
from omegaconf import OmegaConf

from envs import NavigationEnv, get_scene
from recipes.drex.cards import metadata
from recipes.evaluation.setting import trained_in
from recipes.training.policies import card_config


def test_a_card_holds_the_files_that_its_scenes_are_made_of(tmp_path):
    hall = tmp_path / "hall.yaml"
    hall.write_text("{start: [0, 0, 0], goal: [[7, 8], 0], people: [{at: [4, [1, 2]]}]}")
    mine = tmp_path / "mine.yaml"
    mine.write_text("mixture: {hall.yaml: 1, empty: 1}")
    scene = get_scene(mine)
    cfg = OmegaConf.create(
        {
            "env": {"scene": str(mine), "robot": "turtlebot2"},
            "evaluation": {"scene": {"mixture": {str(hall): 2}}},
        }
    )
    card = json.loads(json.dumps({"config": card_config(cfg)}))
    expected = NavigationEnv(scene=cfg.evaluation.scene, num_envs=8, seed=0).reset()
    for file in (hall, mine):
        file.unlink()
    there = NavigationEnv(scene=trained_in(card).scene, num_envs=8, seed=0).reset()
    assert torch.equal(there["scene", "people"], expected["scene", "people"])
    # A training that goes on from this policy reads where it was trained.
    assert get_scene(OmegaConf.create(card["config"]["env"]["scene"])) == scene


def test_the_card_of_demonstrations_holds_the_files_of_scene_and_robot(tmp_path):
    scene, robot = tmp_path / "door.yaml", tmp_path / "small.yaml"
    scene.write_text("{start: [0, 0, 0], goal: [8, 0], human: [4, 1.5]}")
    robot.write_text("{radius: 0.15, max_speed: 0.4}")
    shown = {"dataset": None, "radius": 1.0, "side": "right", "speed": 0.4}
    cfg = OmegaConf.create(
        {"env": {"scene": str(scene), "robot": str(robot)}, "demonstrations": shown}
    )
    card = json.loads(json.dumps(metadata(cfg)))
    assert card["config"]["env"]["scene"]["goal"] == [8, 0]
    kept = {"name": "small", "radius": 0.15, "max_speed": 0.4}
    assert card["config"]["env"]["robot"] == card["demonstrator"]["robot"] == kept
