"""The navigation task as a policy sees it: an environment like any other, before its first step too."""

from __future__ import annotations

import copy

import pytest
import torch

from envs.policy_env import make_policy_env
from torchrl_morl.preferences import PreferenceSpace
from torchrl_morl.transforms import PreferenceSampler

SPACE = PreferenceSpace(("core", "distance", "efficiency"), static={"core": 1.0})


def make(seed: int = 0):
    sampler = PreferenceSampler(SPACE, seed=seed)
    return make_policy_env(sampler, num_envs=2, num_threads=1, scene="empty", seed=seed)


def test_a_new_environment_has_its_whole_state():
    state = make().state_dict()
    assert torch.equal(state["transforms.0.loc"], torch.tensor([[0.25, 0.0]]).expand(2, 2))
    torch.testing.assert_close(
        state["transforms.0.scale"], torch.tensor([[0.25, torch.pi]]).expand(2, 2)
    )
    used = make()
    used.rollout(3)
    assert set(used.state_dict()) == set(state)


def test_a_state_goes_into_a_new_environment():
    used, new = make(0), make(1)
    used.rollout(3)
    new.load_state_dict(used.state_dict())
    assert torch.equal(new.reset()["preference"], used.reset()["preference"])


@pytest.mark.parametrize("steps", [0, 3])
def test_a_copy_drives_on_by_itself(steps):
    env = make()
    if steps:
        env.rollout(steps)
    twin = copy.deepcopy(env)
    rollouts = []
    for each in (env, twin):
        torch.manual_seed(0)  # of the actions
        rollouts.append(each.rollout(4))
    first, second = rollouts
    for key in ("observation", "preference", ("next", "reward")):
        assert torch.equal(first[key], second[key])
