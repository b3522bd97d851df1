"""The navigation task as a policy sees it: an environment like any other, before its first step too."""

from __future__ import annotations

import copy

import pytest
import torch

from envs.policy_env import make_policy_env
from torchrl_morl.deploy.features import observation_parts
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


@pytest.mark.parametrize("robot", ["any", "turtlebot2", "hsr"])
@pytest.mark.parametrize("observe_robot", [True, False])
def test_what_was_told_and_what_was_measured_are_in_the_same_units(robot, observe_robot):
    """A robot without faults that is told the same again and again does it, whichever robot it is."""
    arguments = {"robot": robot, "observe_robot": observe_robot, "observe_motion": True}
    env = make_policy_env(num_envs=8, num_threads=1, scene="empty", seed=0, **arguments)
    parts = observation_parts(observe_robot=observe_robot, observe_motion=True)
    data = env.reset()
    action = torch.tensor([0.2, 0.3]).expand(8, 2)  # of what the drive can do, 0.6 and 0.3
    for _ in range(8):
        data = env.step(data.set("action", action))["next"]
    motion = data["observation"][:, list(parts["motion"])].unflatten(-1, (-1, 2))
    measured, told = motion[:, 0], motion[:, 1]
    torch.testing.assert_close(measured, told, rtol=0.03, atol=0.01)
    if observe_robot:
        torch.testing.assert_close(told, torch.tensor([0.6, 0.3]).expand(8, 2))
    env.close()
