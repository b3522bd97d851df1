"""Every policy that comes with the checkout: it loads, tells what made it, and drives."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from envs.policy_env import make_policy_env
from recipes.evaluation.setting import trained_in
from torchrl_morl.deploy import load_policy
from torchrl_morl.transforms import PreferenceSampler

FOLDERS = sorted((Path(__file__).resolve().parents[2] / "recipes" / "policies").iterdir())


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_it_drives_a_second_in_the_environment_of_its_card(folder):
    policy = load_policy(folder)
    config = policy.card["config"]
    scene = config.get("evaluation", {}).get("scene", config["env"]["scene"])
    env = make_policy_env(
        PreferenceSampler(policy.preference_space, seed=0),
        num_envs=3,
        scene=scene,
        seed=0,
        **trained_in(policy.card).observed,
    )
    with torch.no_grad():
        rollout = env.rollout(5, policy.actor, break_when_any_done=False)
    env.close()
    way = (rollout["next", "pose"] - rollout["pose"])[..., :2].norm(dim=-1).sum(-1)
    assert (way > 0.2).all(), way


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_its_card_names_no_place_of_the_machine_that_made_it(folder):
    def strings(value):
        if isinstance(value, dict):
            value = list(value.values())
        if isinstance(value, list):
            for item in value:
                yield from strings(item)
        elif isinstance(value, str):
            yield value

    found = list(strings(json.loads((folder / "policy.json").read_text())))
    assert found
    assert not [text for text in found if Path(text).is_absolute()]
