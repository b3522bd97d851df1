"""What a collision costs one objective more."""

import pytest
import torch
from omegaconf import OmegaConf
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs

from envs import NavigationEnv
from recipes.training.collisions import CollisionReward
from recipes.training.task import make_preference_space, make_train_env
from torchrl_morl.deploy.features import OBSERVATION_SIZE
from torchrl_morl.modules import RewardModel


def _rewards(*transforms: CollisionReward) -> tuple[torch.Tensor, torch.Tensor]:
    """Rewards, and where they came with a collision: everybody drives at full speed."""
    env = TransformedEnv(NavigationEnv(num_envs=32, seed=3))
    for transform in transforms:
        env.append_transform(transform)
    ahead = torch.tensor([0.5, 0.0]).expand(32, 2)
    data = env.rollout(150, policy=lambda td: td.set("action", ahead), break_when_any_done=False)[
        "next"
    ]
    env.close()
    return data["reward"], (data["collision_human"] | data["collision_obstacle"]).squeeze(-1)


def test_one_entry_pays_at_collisions_alone():
    plain, collided = _rewards()
    more, again = _rewards(CollisionReward(-700.0, entry=1))
    assert collided.any() and not collided.all()
    torch.testing.assert_close(again, collided)
    expected = plain.clone()
    expected[..., 1] -= 700.0 * collided
    torch.testing.assert_close(more, expected)


def test_specs_hold():
    env = TransformedEnv(NavigationEnv(num_envs=2, seed=0), CollisionReward(-700.0, entry=0))
    check_env_specs(env)
    env.close()


def test_a_training_charges_the_style():
    """The entry of the style pays, as the configuration says."""
    space = make_preference_space(with_demonstrations=True)
    cfg = OmegaConf.create(
        {
            "seed": 3,
            "env": {"num_envs": 32, "num_threads": 1},
            "preference": {"distribution": "jeffreys", "num_segments": 1},
            "demonstrations": {"collision_reward": 0.0},
        }
    )
    model = RewardModel(in_features=OBSERVATION_SIZE + 2, num_cells=(8,), num_members=1)
    ahead = torch.tensor([1.0, 0.0]).expand(32, 2)
    found = []
    for cost in (0.0, -700.0):
        cfg.demonstrations.collision_reward = cost
        env = make_train_env(cfg, space, model)
        data = env.rollout(
            150, policy=lambda td: td.set("action", ahead), break_when_any_done=False
        )["next"]
        env.close()
        found.append(data)
    collided = (data["collision_human"] | data["collision_obstacle"]).squeeze(-1)
    assert collided.any()
    expected = found[0]["reward"].clone()
    expected[..., space.objectives.index("demo")] -= 700.0 * collided
    torch.testing.assert_close(found[1]["reward"], expected)


def test_a_reward_for_colliding_is_refused():
    with pytest.raises(ValueError, match=r"reward must be at most 0, got 3\.0"):
        CollisionReward(3.0, entry=0)
