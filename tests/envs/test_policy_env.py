"""The navigation task as a policy sees it: an environment like any other, before its first step too."""

from __future__ import annotations

import copy

import pytest
import torch
from tensordict.nn import TensorDictModuleBase

from envs.policy_env import SHOWN, make_policy_env, observation_size
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


class OfAction(TensorDictModuleBase):
    """A reward model that writes the turn rate that it is told, from 0 to 1."""

    in_keys, out_keys = ["observation", "action"], ["demo_score"]

    def forward(self, tensordict):
        assert tensordict["observation"].shape[-1] == self.size
        return tensordict.set("demo_score", (tensordict["action"][..., 1:] + 1) / 2)


@pytest.mark.parametrize(
    "robot",
    [{}, {"robot": "any", "observe_robot": True, "observe_human_velocity": True}],
    ids=["one robot", "any"],
)
def test_with_its_motion_observed_a_robot_is_judged_by_what_it_does(robot):
    """Commands are two steps late: so is what the style pays for."""
    judge = OfAction()
    judge.size = observation_size(robot, SHOWN)
    options = {"num_envs": 2, "num_threads": 1, "scene": "empty", "seed": 0, **robot}
    arguments = options | {"faults": {"latency": 2}}
    turns = torch.tensor([0.0, 0.4, -0.4, 0.2, 0.2, -0.2, 0.0, 0.3])

    def style(**more) -> torch.Tensor:
        env = make_policy_env(reward_model=judge, **arguments, **more)
        data, rewards = env.reset(), []
        for turn in turns:
            data["action"] = torch.tensor([-1.0, turn.item()]).expand(2, 2)
            data = env.step(data)
            rewards.append(data["next", "reward"][:, 1])
            data = data["next"]
        return torch.stack(rewards, -1)

    def paid(turns: torch.Tensor) -> torch.Tensor:
        return (10 * ((turns + 1) / 2 - 1)).expand(2, -1)

    if not robot:  # without its motion: what it is told
        judge.size = observation_size({}, SHOWN)
        torch.testing.assert_close(style(), paid(turns))
    late = torch.cat((torch.zeros(2), turns[:-2]))
    # Servos take a while, those of some robots longer.
    torch.testing.assert_close(style(observe_motion=True), paid(late), atol=1.8, rtol=0)
    assert not torch.allclose(paid(turns), paid(late), atol=2.5)
