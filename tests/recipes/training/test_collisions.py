"""What a collision costs one objective more."""

import pytest
import torch
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs

from envs import NavigationEnv
from recipes.training.collisions import CollisionReward


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


def test_a_reward_for_colliding_is_refused():
    with pytest.raises(ValueError, match=r"reward must be at most 0, got 3\.0"):
        CollisionReward(3.0, entry=0)
