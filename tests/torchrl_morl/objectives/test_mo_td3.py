"""Multi-objective TD3: hand-computed numbers, agreement with TD3Loss, gradients and state."""

from __future__ import annotations

import copy

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.objectives import SoftUpdate, TD3Loss

from tests._mo_td3 import (
    ACT,
    OBS,
    SPACE,
    SPEC,
    make_batch,
    make_loss,
    make_networks,
    seeded,
)
from torchrl_morl.modules import PreferenceInterpolator, make_actor, make_vector_critic
from torchrl_morl.objectives import MOTD3Loss
from torchrl_morl.preferences import PreferenceSpace

# --- Numbers worked out by hand: two objectives, three transitions, critics that are lookup tables.


class _Table(nn.Module):
    """Row ``i`` of a table for the one-hot observation ``i``."""

    def __init__(self, rows: list[list[float]]) -> None:
        super().__init__()
        self.rows = nn.Parameter(torch.tensor(rows))

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        return observation @ self.rows


# Rows 0 to 2 belong to the states of the transitions, rows 3 to 5 to their next states.
Q1 = [[3.0, 0.0], [1.0, 0.5], [0.0, 2.0], [4.0, 0.0], [1.0, 2.0], [3.0, 9.0]]
Q2 = [[1.0, -1.0], [0.0, 0.5], [2.0, 4.0], [0.0, 4.0], [2.0, 0.0], [5.0, -9.0]]
PREFERENCE = [[0.25, 0.75], [0.5, 0.5], [1.0, 0.0]]


def _table_critic(rows: list[list[float]]) -> TensorDictModule:
    return TensorDictModule(_Table(rows), in_keys=["observation"], out_keys=["state_action_value"])


def _table_loss(q1=Q1, q2=Q2, **kwargs) -> MOTD3Loss:
    actor = TensorDictModule(
        _Table([[1.0, -2.0]] * 6), in_keys=["observation"], out_keys=["pre_tanh"]
    )
    tanh = TensorDictModule(torch.tanh, in_keys=["pre_tanh"], out_keys=["action"])
    loss = MOTD3Loss(
        TensorDictSequential(actor, tanh),
        [_table_critic(q1), _table_critic(q2)],
        bounds=(-1.0, 1.0),
        **kwargs,
    )
    loss.make_value_estimator(gamma=0.5)
    return loss


def _table_batch() -> TensorDict:
    one_hot = torch.eye(6)
    terminated = torch.tensor([[False], [False], [True]])
    return TensorDict(
        observation=one_hot[:3],
        preference=torch.tensor(PREFERENCE),
        action=torch.zeros(3, 1),
        next=TensorDict(
            observation=one_hot[3:],
            reward=torch.tensor([[1.0, -1.0], [0.0, 0.5], [2.0, 2.0]]),
            done=terminated,
            terminated=terminated,
            batch_size=3,
        ),
        batch_size=3,
    )


@pytest.mark.parametrize(
    ("selection", "targets", "next_value"),
    [
        # Utilities of the next values: critic 1 (1, 1.5, 3), critic 2 (3, 1, 5): take 1, 2, 1.
        ("utility", [[3.0, -1.0], [1.0, 0.5], [2.0, 2.0]], [1.0, 1.0, 3.0]),
        # Elementwise minima: (0, 0), (1, 0), (3, -9), which no critic has predicted.
        ("elementwise", [[1.0, -1.0], [0.5, 0.5], [2.0, 2.0]], [0.0, 0.5, 3.0]),
    ],
)
def test_target_by_hand(selection, targets, next_value):
    loss = _table_loss(target_selection=selection, reduction="none")
    value, metadata = loss.value_loss(_table_batch())
    targets = torch.tensor(targets)
    utility = (torch.tensor(PREFERENCE) * targets).sum(-1)
    torch.testing.assert_close(metadata["target_value"], utility)
    torch.testing.assert_close(metadata["next_state_value"], torch.tensor(next_value))
    error = torch.stack([torch.tensor(table[:3]) - targets for table in (Q1, Q2)])
    torch.testing.assert_close(metadata["td_error"], error.pow(2).mean(-1))
    huber = torch.where(error.abs() < 1, error.pow(2) / 2, error.abs() - 0.5)
    torch.testing.assert_close(value, huber.mean(-1).sum(0))


def test_target_is_selected_by_the_preference_of_the_next_state():
    batch = _table_batch()
    batch["next", "preference"] = torch.tensor(PREFERENCE).flip(-1)
    _, metadata = _table_loss().value_loss(batch)
    # Critic 1 (3, 1.5, 9), critic 2 (1, 1, -9): take 2, 2, 2; the last one is terminal.
    torch.testing.assert_close(metadata["next_state_value"], torch.tensor([1.0, 1.0, -9.0]))
    # Rewards plus half of (0, 4) and (2, 0), under the preference of the state itself.
    torch.testing.assert_close(metadata["target_value"], torch.tensor([1.0, 0.75, 2.0]))


def test_losses_by_hand():
    loss = _table_loss(pre_tanh_coeff=0.1)
    batch = _table_batch()
    out = loss(batch)
    # Smooth-l1: critic 1 (0.25, 0, 0.75), critic 2 (0.75, 0.25, 0.75), averaged over the batch.
    torch.testing.assert_close(out["loss_qvalue"], torch.tensor(2.75 / 3))
    # Utilities of critic 1: (0.75, 0.75, 0); pre-tanh outputs (1, -2).
    torch.testing.assert_close(out["loss_actor"], torch.tensor(-0.5 + 0.1 * 2.5))
    torch.testing.assert_close(out["state_action_value_actor"], torch.tensor([0.75, 0.75, 0.0]))
    expected = torch.tensor([[0.75, 0.75, 0.0], [-0.5, 0.25, 2.0]])
    torch.testing.assert_close(out["pred_value"], expected)
    torch.testing.assert_close(out["q_scale"], torch.tensor([7.0 / 6, 8.0 / 6]))
    torch.testing.assert_close(batch["td_error"], torch.tensor([2.0, 0.5, 2.0]))
    # tanh(1) = 0.76 and tanh(2) = 0.964.
    assert out["saturated_fraction"] == 0.0


@pytest.mark.parametrize("angle", ["normalized", "raw"])
def test_angle_by_hand(angle):
    # An unfitted interpolator is the identity: angles between (.25, .75) and (3, 0), (.5, .5) and
    # (1, .5), (1, 0) and (0, 2).
    expected = torch.tensor([1.2490458, 0.3217506, 1.5707963])
    if angle == "raw":
        expected = expected.rad2deg()
    interpolator = PreferenceInterpolator(torch.eye(2), value_space=angle)
    loss = _table_loss(
        interpolator=interpolator,
        angle=angle,
        angle_coeff_actor=2.0,
        angle_coeff_critic=3.0,
        reduction="none",
    )
    out = loss(_table_batch())
    torch.testing.assert_close(out["angle"], expected)
    plain = _table_loss(reduction="none")(_table_batch())
    torch.testing.assert_close(out["loss_actor"], plain["loss_actor"] + 2 * expected)
    # Critic 2: (1, -1), (0, .5), (2, 4).
    second = torch.tensor([2.0344439, 0.7853982, 1.1071487])
    if angle == "raw":
        second = torch.tensor([90.0, 45.0, 63.434949])
    added = out["loss_qvalue"] - plain["loss_qvalue"]
    torch.testing.assert_close(added, 3 * (expected + second))


def test_angle_is_taken_in_the_normalised_space():
    interpolator = PreferenceInterpolator(torch.eye(2), identity=True)
    interpolator.refit(torch.tensor([[4.0, -2.0], [-1.0, 2.0]]))
    loss = _table_loss(interpolator=interpolator, angle="normalized")
    # Critic 1 after (q - (-1, -2)) / (5, 4): (.8, .5), (.4, .625), (.2, 1).
    values = torch.tensor([[0.8, 0.5], [0.4, 0.625], [0.2, 1.0]])
    cosine = torch.nn.functional.cosine_similarity(torch.tensor(PREFERENCE), values, dim=-1)
    torch.testing.assert_close(loss(_table_batch())["angle"], cosine.acos())


def test_angle_ignores_static_objectives():
    def angle(core: float) -> torch.Tensor:
        preference_space = PreferenceSpace(("a", "core", "b"), static={"core": 1.0})
        tables = [[[row[0], core, row[1]] for row in table] for table in (Q1, Q2)]
        batch = _table_batch()
        batch["next", "reward"] = torch.zeros(3, 3)
        loss = _table_loss(
            *tables,
            preference_space=preference_space,
            interpolator=PreferenceInterpolator(torch.eye(2)),
            angle="normalized",
        )
        return loss(batch)["angle"]

    expected = torch.tensor([1.2490458, 0.3217506, 1.5707963])
    torch.testing.assert_close(angle(0.0), expected)
    torch.testing.assert_close(angle(-500.0), expected)


def test_static_weight_counts_in_the_utility():
    preference_space = PreferenceSpace(("core", "a", "b"), static={"core": 2.0})
    tables = [[[10.0, *row] for row in table] for table in (Q1, Q2)]
    loss = _table_loss(*tables, preference_space=preference_space)
    value = loss.actor_loss(_table_batch())[0]
    torch.testing.assert_close(value, torch.tensor(-20.5))


def test_number_of_steps_enters_the_discount():
    batch = _table_batch()
    batch["steps_to_next_obs"] = torch.tensor([[1], [3], [1]])
    _, metadata = _table_loss().value_loss(batch)
    # Second transition: reward (0, .5) and .5 ** 3 of (2, 0).
    torch.testing.assert_close(metadata["target_value"], torch.tensor([0.0, 0.375, 2.0]))


def test_saturated_fraction_counts_actions_at_their_bounds():
    loss = make_loss()
    last = loss.actor_network_params["module", "0", "module", "2"].data
    last["weight"].zero_()
    assert loss(make_batch(8))["saturated_fraction"] == 0
    last["bias"].copy_(torch.tensor([0.0, 5.0]))
    assert loss(make_batch(8))["saturated_fraction"] == 0.5


# --- Agreement with TorchRL's TD3Loss.


@pytest.mark.parametrize("delayed", [True, False])
@pytest.mark.parametrize("selection", ["utility", "elementwise"])
def test_one_objective_equals_td3(delayed, selection):
    actor, critic = make_networks(num_objectives=1, num_tunable=1)
    losses = []
    kwargs = {"action_spec": SPEC, "delay_actor": delayed, "delay_qvalue": delayed}
    for cls, extra in ((TD3Loss, {}), (MOTD3Loss, {"target_selection": selection})):
        torch.manual_seed(7)
        losses.append(cls(copy.deepcopy(actor), copy.deepcopy(critic), **kwargs, **extra))
    batch = make_batch(32, num_objectives=1, num_tunable=1)
    batches = [batch.clone(), batch.clone()]
    outs = []
    for loss, data in zip(losses, batches):
        torch.manual_seed(1)
        outs.append(loss(data))
        (outs[-1]["loss_actor"] + outs[-1]["loss_qvalue"]).backward()
    stock, ours = outs
    for key in ("loss_actor", "loss_qvalue", "next_state_value", "pred_value", "target_value"):
        torch.testing.assert_close(ours[key], stock[key], rtol=1e-6, atol=1e-7)
    torch.testing.assert_close(
        ours["state_action_value_actor"], stock["state_action_value_actor"][0]
    )
    torch.testing.assert_close(batches[1]["td_error"], batches[0]["td_error"])
    gradients = [[p.grad for p in loss.parameters()] for loss in losses]
    assert len(gradients[0]) == len(gradients[1]) > 0
    torch.testing.assert_close(gradients[1], gradients[0])


# --- Gradients, state and coefficients.


@pytest.mark.parametrize("angle", ["normalized", "raw"])
def test_each_loss_trains_its_own_network(angle):
    loss = make_loss(angle=angle)
    actor = list(loss.actor_network_params.parameters())
    critic = list(loss.qvalue_network_params.parameters())
    batch = make_batch(16)
    loss.actor_loss(batch)[0].backward()
    assert all((p.grad != 0).any() for p in actor)
    assert all(p.grad is None for p in critic)
    loss.zero_grad()
    loss.value_loss(batch)[0].backward()
    assert all(p.grad is None for p in actor)
    assert all((p.grad != 0).any() for p in critic)
    assert not any(value.requires_grad for value in loss.interpolator.buffers())
    assert not any(value.requires_grad for value in loss.buffers())


def test_angle_adds_a_gradient_to_every_parameter():
    loss, batch = make_loss(), make_batch(16)
    gradients = []
    for coefficient in (0.0, 1.0):
        loss.angle_coeff_actor = loss.angle_coeff_critic = coefficient
        loss.zero_grad()
        out = seeded(loss, batch)
        (out["loss_actor"] + out["loss_qvalue"]).backward()
        gradients.append([p.grad.clone() for p in loss.parameters()])
    assert not any(torch.allclose(off, on) for off, on in zip(*gradients))


def test_interpolator_is_saved_but_not_trained():
    loss = make_loss()
    names = [name for name in loss.state_dict() if name.startswith("interpolator.")]
    assert "interpolator.coefficients" in names
    assert not any(name.startswith("interpolator") for name, _ in loss.named_parameters())


def test_state_dict_round_trip():
    loss, other = (
        make_loss(),
        make_loss(angle_coeff_actor=0.9, interpolator=PreferenceInterpolator(torch.eye(2))),
    )
    batch = make_batch(16)
    expected = seeded(loss, batch)
    assert not torch.allclose(seeded(other, batch)["loss_actor"], expected["loss_actor"])
    other.load_state_dict(loss.state_dict())
    torch.testing.assert_close(seeded(other, batch), expected)


def test_coefficients_are_scheduled_in_place():
    loss = make_loss(angle_coeff_actor=1, angle_coeff_critic=0, pre_tanh_coeff=0)
    batch = make_batch(16)
    buffer = loss.angle_coeff_actor
    before = loss.actor_loss(batch)
    loss.angle_coeff_actor = 1.25
    after = loss.actor_loss(batch)
    assert loss.angle_coeff_actor is buffer
    torch.testing.assert_close(after[0] - before[0], 0.25 * before[1]["angle"].mean())
    loss.pre_tanh_coeff = 0.5
    assert loss.actor_loss(batch)[0] > after[0]


def test_soft_update_moves_the_targets():
    loss = make_loss()
    updater = SoftUpdate(loss, tau=0.5)
    loss.qvalue_network_params.data.add_(1.0)
    target = loss.target_qvalue_network_params["module", "0", "bias"].clone()
    updater.step()
    moved = loss.target_qvalue_network_params["module", "0", "bias"]
    torch.testing.assert_close(moved, target + 0.5)


def test_reset_parameters_recursive():
    loss = make_loss()
    parameters = [p.clone() for p in loss.actor_network_params.values(True, True)]
    interpolator = loss.interpolator.coefficients.clone()
    loss.reset_parameters_recursive()
    first = loss.actor_network_params["module", "0", "module", "0", "weight"]
    assert not any(first.shape == p.shape and torch.equal(first, p) for p in parameters)
    assert torch.equal(loss.interpolator.coefficients, interpolator)
    assert loss(make_batch(4))["loss_actor"].isfinite()


def test_separate_losses_detach_a_shared_trunk():
    trunk = TensorDictModule(nn.Linear(OBS, 8), in_keys=["observation"], out_keys=["hidden"])
    head = make_actor(SPEC, in_features=8 + 2, in_keys=["hidden", "preference"], num_cells=(8,))
    critic = make_vector_critic(
        3, in_features=8 + 2 + ACT, in_keys=["hidden", "preference", "action"], num_cells=(8,)
    )
    loss = MOTD3Loss(
        TensorDictSequential(trunk, head),
        TensorDictSequential(trunk, critic),
        preference_space=SPACE,
        action_spec=SPEC,
        separate_losses=True,
    )
    loss.value_loss(make_batch(8))[0].backward()
    assert trunk.module.weight.grad is None
    loss.actor_loss(make_batch(8))[0].backward()
    assert (trunk.module.weight.grad != 0).any()
