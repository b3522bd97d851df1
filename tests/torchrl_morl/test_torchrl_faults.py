"""Faults of TorchRL and PyTorch that are worked around here: each test fails once they are repaired.

Then the workaround that it names can go.
"""

from __future__ import annotations

import copy
import pickle

import pytest
import torch
from torchrl.data import LazyStackStorage, TensorDictReplayBuffer
from torchrl.envs import ActionScaling, RewardScaling, TransformedEnv
from torchrl.objectives import TD3Loss

from tests._mo_td3 import SPEC, make_batch, make_networks
from torchrl_morl.testing import VectorRewardMockEnv


def td3() -> TD3Loss:
    return TD3Loss(*make_networks(num_objectives=1, num_tunable=1), action_spec=SPEC)


def batch():
    return make_batch(8, num_objectives=1, num_tunable=1)


def test_a_copied_td3_loss_trains_its_actor_against_a_frozen_critic():
    """``MOTD3Loss._first_critic``; the cache is that of https://github.com/pytorch/rl/pull/1272."""
    loss, data = td3(), batch()
    loss.actor_loss(data)
    twin = copy.deepcopy(loss)
    before = twin.actor_loss(data)[0]
    with torch.no_grad():
        twin.qvalue_network_params.apply_(lambda p: p.mul_(3.0))
    assert torch.equal(twin.actor_loss(data)[0], before)


def test_a_td3_loss_cannot_be_pickled():
    """``MOTD3Loss.__getstate__``."""
    with pytest.raises((AttributeError, pickle.PicklingError), match="decorated_module"):
        pickle.dumps(td3())


def test_a_td3_loss_changes_its_state_dict_at_the_first_call():
    """``MOTD3Loss.__init__``; the same in https://github.com/pytorch/rl/issues/1594."""
    loss = td3()
    before = set(loss.state_dict())
    loss(batch())
    assert set(loss.state_dict()) - before == {"_value_estimator.gamma"}


def test_action_scaling_has_no_state_before_its_first_use():
    """``make_policy_env``; since https://github.com/pytorch/rl/pull/3765."""
    env = TransformedEnv(VectorRewardMockEnv(3), ActionScaling())
    with pytest.raises(ValueError, match="uninitialized"):
        env.state_dict()
    with pytest.raises(ValueError, match="uninitialized"):
        copy.deepcopy(env)
    _ = env.action_spec
    assert set(env.state_dict()) == {"loc", "scale"}


def test_a_sample_time_transform_writes_into_a_storage_of_elements():
    """``torchrl_morl.transforms.stored``."""
    buffer = TensorDictReplayBuffer(
        storage=LazyStackStorage(8),
        batch_size=8,
        transform=RewardScaling(0.0, 2.0, in_keys=[("next", "reward")]),
    )
    buffer.extend(batch())
    sizes = []
    for _ in range(3):
        buffer.sample()
        sizes.append(
            torch.stack([x["next", "reward"] for x in buffer._storage._storage]).abs().sum()
        )
    assert sizes[0] < sizes[1] < sizes[2]


def test_a_compiled_draw_of_any_size_must_not_name_the_global_generator():
    """``torchrl_morl.generators``; https://github.com/pytorch/pytorch/issues/107170."""

    @torch.compile(backend="eager", dynamic=True, fullgraph=True)
    def draw(like: torch.Tensor) -> torch.Tensor:
        return torch.rand(like.shape, generator=None)

    with pytest.raises(RuntimeError, match="generator"):
        draw(torch.zeros(6))
