"""What training among humans who walk adds: mixed scenes, and the human's velocity."""

from __future__ import annotations

import math

import pytest
import torch
from torchrl.envs.utils import check_env_specs

from envs import SCENES, NavigationEnv
from envs.policy_env import make_policy_env, observation_size
from recipes.drex import ranking
from tests._drex import config
from torchrl_morl.deploy.features import policy_transforms
from torchrl_morl.modules import RewardModel


def sample(name: str, count: int = 400):
    return SCENES[name].sample(count, 0.177, torch.Generator().manual_seed(3))


def test_half_of_the_mixed_scenes_explore_and_half_have_a_moving_human():
    """They are the scenes of the two, for which other tests stand; the distribution of the mix is what is new."""
    generator = torch.Generator().manual_seed(3)
    parts = [SCENES[name].sample(400, 0.177, generator) for name in ("exploring", "moving_human")]
    mixed = sample("mixed")
    exploring, walks = (
        torch.stack([(mixed[key] == part[key]).flatten(1).all(-1) for key in mixed.keys()]).all(0)
        for part in parts
    )
    assert (exploring ^ walks).all()
    assert abs(walks.double().mean() - 0.5) < 4 * 0.5 / 20
    stands = (mixed["human"][:, :2] == mixed["human_goal"]).all(-1)
    assert torch.equal(stands, exploring)


def test_in_one_batch_some_humans_walk_and_the_others_do_not_move_at_all():
    env = NavigationEnv(num_envs=16, num_threads=1, scene="mixed", seed=0, num_rays=1)
    data = env.reset()
    start, goal = data["human_pose"].clone(), data["scene", "human_goal"].clone()
    for _ in range(3):
        data = env.step(data.set("action", torch.zeros(16, 2)))["next"]
    moved = (data["human_pose"] - start)[:, :2].norm(dim=-1)
    walks = (start[:, :2] != goal).any(-1)
    assert 2 < walks.sum() < 14
    torch.testing.assert_close(moved[walks], torch.full_like(moved[walks], 0.3))
    assert torch.equal(data["human_pose"][~walks], start[~walks])


def test_the_policy_sees_where_the_human_walks():
    env = make_policy_env(
        num_envs=24, num_threads=1, scene="mixed", seed=0, observe_human_velocity=True
    )
    check_env_specs(env)
    env.base_env.set_seed(0)
    data = env.reset()
    assert data["observation"].shape == (24, observation_size({"observe_human_velocity": True}))
    assert (data["observation"][:, 36:] == 0).all()
    walks = data["human_pose"][:, 2] == math.pi  # from the goal to the start: along -x
    assert 5 < walks.sum() < 19
    for _ in range(4):
        data = env.step(data.set("action", torch.rand(24, 2) * 2 - 1))["next"]
        # Against the heading, 0.5 m/s along -x are as much ahead as the cosine of pi - heading.
        heading = data["pose"][:, 2]
        seen = 0.5 * torch.stack((-heading.cos(), heading.sin()), -1) * walks[:, None]
        torch.testing.assert_close(data["observation"][:, 36:], seen.float(), rtol=0, atol=1e-6)


def test_without_the_velocity_observations_are_the_same():
    pair = [
        make_policy_env(num_envs=4, num_threads=1, scene="mixed", seed=2, observe_human_velocity=on)
        for on in (False, True)
    ]
    without, with_velocity = (env.reset() for env in pair)
    assert without["observation"].shape[-1] == 36
    assert torch.equal(without["observation"], with_velocity["observation"][:, :36])


def test_a_human_who_is_not_observed_has_no_velocity():
    with pytest.raises(ValueError, match="observe_human_velocity needs observe_human"):
        policy_transforms(observe_human=False, observe_human_velocity=True)
    with pytest.raises(ValueError, match="observe_human_velocity must be true or false, got 1"):
        policy_transforms(observe_human_velocity=1)


def test_a_reward_model_does_not_know_the_velocity_unless_it_is_told():
    cfg = config("drex", ("env.observe_human_velocity=true", "reward_model.num_cells=[8]"))
    assert ranking.hidden_entries(cfg) == [36, 37]
    model = ranking.make_reward_model(cfg)
    assert isinstance(model, RewardModel)
    first = model.module.members[0][0]
    assert first.in_features == 38 + 2
    assert (first.weight[:, 36:38] == 0).all() and (first.weight[:, :36] != 0).any()
    cfg.reward_model.inputs = ["lidar", "goal", "human", "human_velocity", "action"]
    assert ranking.hidden_entries(cfg) == []
