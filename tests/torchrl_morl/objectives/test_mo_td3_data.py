"""Multi-objective TD3 on data as TorchRL stores it: several steps, priorities, every storage."""

from __future__ import annotations

import copy

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import (
    Bounded,
    LazyMemmapStorage,
    LazyStackStorage,
    LazyTensorStorage,
    ListStorage,
    TensorDictPrioritizedReplayBuffer,
    TensorDictReplayBuffer,
)
from torchrl.envs import MultiStepTransform, TransformedEnv
from torchrl.objectives import SoftUpdate, TD3Loss

from tests._mo_td3 import SPEC, make_batch, make_loss, make_networks, seeded
from torchrl_morl.modules import make_actor, make_vector_critic
from torchrl_morl.objectives import MOTD3Loss, MultiObjectiveGAE
from torchrl_morl.preferences import PreferenceSpace
from torchrl_morl.testing import VectorRewardMockEnv
from torchrl_morl.transforms import PreferenceRelabel, PreferenceSampler

THREE = PreferenceSpace(("a", "b", "c"))


def rollout() -> TensorDict:
    env = VectorRewardMockEnv(3, batch_size=(4,), seed=0)
    return TransformedEnv(env, PreferenceSampler(THREE, seed=0)).rollout(
        16, break_when_any_done=False
    )


def loss_for(data: TensorDict, **kwargs) -> MOTD3Loss:
    sizes = data["observation"].shape[-1] + 3
    action = data["action"].shape[-1]
    return MOTD3Loss(
        make_actor(SPEC, in_features=sizes, num_cells=(8,)),
        make_vector_critic(3, in_features=sizes + action, num_cells=(8,)),
        preference_space=THREE,
        **({"action_spec": SPEC} | kwargs),
    )


def test_the_spec_of_several_environments_is_that_of_one():
    env = VectorRewardMockEnv(3, batch_size=(4,), seed=0)
    data = rollout()
    one, several = (loss_for(data, action_spec=spec) for spec in (SPEC, env.action_spec))
    assert several.max_action.shape == several.min_action.shape == data["action"].shape[-1:]
    several.load_state_dict(one.state_dict())
    for batch in (data, data.reshape(-1), data[0], data.reshape(2, 2, 16)):
        torch.manual_seed(0)
        expected = one(batch.clone())["loss_qvalue"]
        torch.manual_seed(0)
        assert torch.equal(several(batch.clone())["loss_qvalue"], expected)


@pytest.mark.parametrize("batch", [(4,), (2, 3)])
def test_environments_with_bounds_of_their_own_are_refused(batch):
    high = torch.ones(*batch, *SPEC.shape)
    high.view(-1, *SPEC.shape)[1] = 2.0
    spec = Bounded(-torch.ones_like(high), high)
    data = make_batch(4)
    with pytest.raises(ValueError, match="action_spec has different bounds within its batch"):
        loss_for(data, action_spec=spec)


def test_a_batch_without_what_came_next_is_named():
    data = rollout()
    with pytest.raises(KeyError, match=r"the batch has no .*reward.*: give transitions"):
        loss_for(data)(data.exclude("next"))


# --- Several steps: MultiStepTransform writes `steps_to_next_obs` of shape [B].


def constant_value_loss(value: float, gamma: float) -> MOTD3Loss:
    """Critics that answer ``value`` for every objective, everywhere."""
    linear = nn.Linear(2, 3)
    nn.init.zeros_(linear.weight)
    nn.init.constant_(linear.bias, value)
    critic = TensorDictModule(linear, in_keys=["observation"], out_keys=["state_action_value"])
    actor = make_actor(SPEC, in_features=2, in_keys=["observation"], num_cells=())
    loss = MOTD3Loss(
        actor,
        [critic],
        num_qvalue_nets=1,
        preference_space=THREE,
        action_spec=SPEC,
        reduction="none",
    )
    loss.make_value_estimator(gamma=gamma)
    return loss


def test_steps_of_multi_step_transform_by_hand():
    # Rewards of environment 0: none ends before step 5. Sums of up to three discounted ones, and the
    # value 7 of the state behind them.
    gamma, value, data = 0.5, 7.0, rollout()
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(100, ndim=1), transform=MultiStepTransform(3, gamma), batch_size=4
    )
    buffer.extend(data[0, :5])
    stored = buffer[:]
    assert stored["steps_to_next_obs"].ndim == 1
    steps = stored["steps_to_next_obs"].tolist()
    _, metadata = constant_value_loss(value, gamma).value_loss(stored)
    rewards, preferences = data["next", "reward"][0], data["preference"][0]
    assert steps[0] == 3
    for t, n in enumerate(steps):
        end = bool(stored["next", "terminated"][t])
        target = sum(gamma**k * rewards[t + k] for k in range(n)) + (0 if end else gamma**n * value)
        torch.testing.assert_close(metadata["target_value"][t], (preferences[t] * target).sum())


@pytest.mark.parametrize("shape", [(16,), (16, 1)])
def test_with_one_objective_several_steps_are_those_of_td3(shape):
    batch = make_batch(16, num_objectives=1, num_tunable=1)
    batch["steps_to_next_obs"] = torch.randint(1, 4, shape)
    outs = []
    for cls in (MOTD3Loss, TD3Loss):
        torch.manual_seed(3)
        loss = cls(*make_networks(num_objectives=1, num_tunable=1), action_spec=SPEC)
        loss.make_value_estimator(gamma=0.5)
        outs.append(seeded(loss, batch))
    torch.testing.assert_close(outs[0]["loss_qvalue"], outs[1]["loss_qvalue"])
    del batch["steps_to_next_obs"]
    loss = MOTD3Loss(*make_networks(num_objectives=1, num_tunable=1), action_spec=SPEC)
    assert not torch.allclose(seeded(loss, batch)["loss_qvalue"], outs[0]["loss_qvalue"])


def test_steps_of_a_batch_of_two_dimensions():
    loss, batch = make_loss(policy_noise=0.0), make_batch(4, 3)
    batch["steps_to_next_obs"] = torch.randint(1, 4, (4, 3))
    square, flat = loss(batch.clone()), loss(batch.reshape(-1))
    torch.testing.assert_close(square["loss_qvalue"], flat["loss_qvalue"])


def test_flags_for_every_objective_are_those_of_all():
    loss, batch = make_loss(policy_noise=0.0), make_batch(16)
    expected = loss(batch.clone())["loss_qvalue"]
    for key in ("done", "terminated"):
        batch["next", key] = batch["next", key].expand(16, 3)
    batch["steps_to_next_obs"] = torch.ones(16, 3, dtype=torch.long)
    torch.testing.assert_close(loss(batch)["loss_qvalue"], expected)


def test_truncations_of_one_entry_per_step_in_advantages():
    data = TensorDict(
        preference=torch.full((1, 4, 3), 1 / 3),
        state_value=torch.ones(1, 4, 3),
        next=TensorDict(
            state_value=torch.ones(1, 4, 3),
            reward=torch.zeros(1, 4, 3),
            done=torch.tensor([[[False], [False], [False], [True]]]),
            terminated=torch.zeros(1, 4, 1, dtype=torch.bool),
            truncated=torch.tensor([[[False], [False], [False], [True]]]),
            batch_size=(1, 4),
        ),
        batch_size=(1, 4),
    )
    outs = []
    for flag in (data["next", "truncated"], data["next", "truncated"].squeeze(-1)):
        gae = MultiObjectiveGAE(
            gamma=0.9, lmbda=0.5, value_network=None, preference_space=THREE, auto_reset_env=True
        )
        outs.append(gae(data.clone().set(("next", "truncated"), flag))["advantage"])
    assert torch.equal(*outs)


# --- Every storage.

STORAGES = {
    "tensor": lambda: LazyTensorStorage(100),
    "tensor of two dimensions": lambda: LazyTensorStorage(100, ndim=2),
    "memmap": lambda: LazyMemmapStorage(100),
    "list": lambda: ListStorage(100),
    "lazy stack": lambda: LazyStackStorage(100),
}


@pytest.mark.parametrize("storage", STORAGES.values(), ids=STORAGES)
def test_trains_from_every_storage(storage):
    data = rollout()
    buffer = TensorDictReplayBuffer(
        storage=storage(), batch_size=32, transform=PreferenceRelabel(THREE, seed=0)
    )
    buffer.extend(data if buffer._storage.ndim == 2 else data.reshape(-1))
    loss = loss_for(data)
    SoftUpdate(loss, tau=0.1)
    for _ in range(2):
        batch = buffer.sample()
        out = loss(batch)
        assert batch["td_error"].shape == batch.shape == (32,)
        (out["loss_actor"] + out["loss_qvalue"]).backward()
        dense = seeded(loss, batch.contiguous())
        torch.testing.assert_close(seeded(loss, batch)["loss_qvalue"], dense["loss_qvalue"])


def test_prioritized_replay():
    data = rollout().reshape(-1)
    try:
        buffer = TensorDictPrioritizedReplayBuffer(
            alpha=1.0,
            beta=1.0,
            storage=LazyTensorStorage(64),
            batch_size=512,
            priority_key="td_error",
        )
    except RuntimeError as error:
        if "SumSegmentTree" not in str(error):
            raise
        pytest.skip("TorchRL's compiled part is built for another version of PyTorch")
    buffer.extend(data)
    loss = loss_for(data, reduction="none", policy_noise=0.0)
    # The errors become the priorities: a transition is drawn in proportion to its own.
    everything = buffer[:]
    loss(everything)
    everything["index"] = torch.arange(64)
    buffer.update_tensordict_priority(everything)
    drawn = torch.cat([buffer.sample()["index"] for _ in range(40)])
    share = torch.bincount(drawn, minlength=64) / len(drawn)
    expected = everything["td_error"] / everything["td_error"].sum()
    torch.testing.assert_close(share, expected, atol=0.01, rtol=0.1)
    # And are weighed against in the loss.
    batch = buffer.sample()
    weight = batch["priority_weight"]
    assert weight.shape == (512,) and weight.min() < weight.max()
    none = loss(batch.exclude("priority_weight"))
    loss.reduction = "mean"
    weighted = loss(batch)
    for key in ("loss_actor", "loss_qvalue"):
        torch.testing.assert_close(weighted[key], (none[key] * weight).sum() / weight.sum())


# --- Copies.


@pytest.mark.parametrize("called", [False, True])
def test_a_copy_trains_its_actor_against_its_own_critic(called):
    loss, batch = make_loss(), make_batch(8)
    if called:
        loss(batch)
    twin = copy.deepcopy(loss)
    before, expected = twin.actor_loss(batch)[0], loss.actor_loss(batch)[0]
    torch.testing.assert_close(before, expected)
    with torch.no_grad():
        twin.qvalue_network_params.apply_(lambda p: p.mul_(3.0))
    assert not torch.allclose(twin.actor_loss(batch)[0], before)
    torch.testing.assert_close(loss.actor_loss(batch)[0], expected)
    # And the other way round.
    now = twin.actor_loss(batch)[0]
    with torch.no_grad():
        loss.qvalue_network_params.apply_(lambda p: p.mul_(3.0))
    torch.testing.assert_close(twin.actor_loss(batch)[0], now)


def test_a_copy_has_networks_of_its_own():
    # What vmap made of the critics belongs to them.
    twin = copy.deepcopy(loss := make_loss())
    twin.qvalue_network.module[1].eps = 1e6  # the LayerNorm: all values become those of its bias
    batch = make_batch(8)
    values = [seeded(x, batch)["pred_value"] for x in (loss, twin)]
    assert values[0].std() > 10 * values[1].std()


def test_parameters_that_are_exchanged_are_noticed():
    loss, batch = make_loss(), make_batch(8)
    loss(batch)
    other = make_loss()
    loss.load_state_dict(other.state_dict(), assign=True)
    torch.testing.assert_close(loss.actor_loss(batch)[0], other.actor_loss(batch)[0])


def test_a_state_before_the_first_call_is_that_after_it():
    loss = make_loss()
    before = set(loss.state_dict())
    loss(make_batch(4))
    assert set(loss.state_dict()) == before
