"""Multi-objective TD3: hand-computed numbers, agreement with TD3Loss and the loss-module contract."""

from __future__ import annotations

import copy

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.data import Bounded, Composite
from torchrl.objectives import SoftUpdate, TD3Loss
from torchrl.objectives.utils import ValueEstimators

from torchrl_morl.modules import PreferenceInterpolator, make_actor, make_vector_critic
from torchrl_morl.objectives import MOTD3Loss
from torchrl_morl.preferences import PreferenceSpace

OBS, ACT = 4, 2
SPEC = Bounded(torch.tensor([-1.0, 0.0]), torch.tensor([1.0, 3.0]))
SPACE = PreferenceSpace(("core", "distance", "efficiency"), static={"core": 1.0})


def _networks(num_objectives: int = 3, num_tunable: int = 2):
    actor = make_actor(SPEC, in_features=OBS + num_tunable, num_cells=(16,), last_layer_gain=1.0)
    critic = make_vector_critic(
        num_objectives, in_features=OBS + num_tunable + ACT, num_cells=(16,)
    )
    return actor, critic


def _interpolator() -> PreferenceInterpolator:
    interpolator = PreferenceInterpolator(torch.eye(2))
    interpolator.refit(torch.tensor([[0.1, -2.0], [-3.0, 0.2]]))
    return interpolator


def _loss(**kwargs) -> MOTD3Loss:
    """A loss with every term on."""
    defaults = {
        "preference_space": SPACE,
        "interpolator": _interpolator(),
        "angle": "normalized",
        "angle_coeff_actor": 0.3,
        "angle_coeff_critic": 0.2,
        "pre_tanh_coeff": 0.1,
        "action_spec": SPEC,
    }
    return MOTD3Loss(*_networks(), **(defaults | kwargs))


def _batch(*batch: int, num_objectives: int = 3, num_tunable: int = 2) -> TensorDict:
    preference = torch.distributions.Dirichlet(torch.ones(num_tunable)).sample(batch)
    terminated = torch.rand(*batch, 1) < 0.3
    return TensorDict(
        observation=torch.randn(*batch, OBS),
        preference=preference,
        action=SPEC.rand(batch),
        next=TensorDict(
            observation=torch.randn(*batch, OBS),
            preference=preference,
            reward=torch.randn(*batch, num_objectives),
            done=terminated | (torch.rand(*batch, 1) < 0.2),
            terminated=terminated,
            batch_size=batch,
        ),
        batch_size=batch,
    )


def _seeded(loss, batch: TensorDict, seed: int = 1) -> TensorDict:
    torch.manual_seed(seed)
    return loss(batch.clone())


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


@pytest.mark.parametrize("angle", ["normalized", "official"])
def test_angle_by_hand(angle):
    # An unfitted interpolator is the identity: angles between (.25, .75) and (3, 0), (.5, .5) and
    # (1, .5), (1, 0) and (0, 2).
    expected = torch.tensor([1.2490458, 0.3217506, 1.5707963])
    if angle == "official":
        expected = expected.rad2deg()
    interpolator = PreferenceInterpolator(torch.eye(2))
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
    if angle == "official":
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
        space = PreferenceSpace(("a", "core", "b"), static={"core": 1.0})
        tables = [[[row[0], core, row[1]] for row in table] for table in (Q1, Q2)]
        batch = _table_batch()
        batch["next", "reward"] = torch.zeros(3, 3)
        loss = _table_loss(
            *tables,
            preference_space=space,
            interpolator=PreferenceInterpolator(torch.eye(2)),
            angle="normalized",
        )
        return loss(batch)["angle"]

    expected = torch.tensor([1.2490458, 0.3217506, 1.5707963])
    torch.testing.assert_close(angle(0.0), expected)
    torch.testing.assert_close(angle(-500.0), expected)


def test_static_weight_counts_in_the_utility():
    space = PreferenceSpace(("core", "a", "b"), static={"core": 2.0})
    tables = [[[10.0, *row] for row in table] for table in (Q1, Q2)]
    loss = _table_loss(*tables, preference_space=space)
    value = loss.actor_loss(_table_batch())[0]
    torch.testing.assert_close(value, torch.tensor(-20.5))


def test_number_of_steps_enters_the_discount():
    batch = _table_batch()
    batch["steps_to_next_obs"] = torch.tensor([[1], [3], [1]])
    _, metadata = _table_loss().value_loss(batch)
    # Second transition: reward (0, .5) and .5 ** 3 of (2, 0).
    torch.testing.assert_close(metadata["target_value"], torch.tensor([0.0, 0.375, 2.0]))


def test_saturated_fraction_counts_actions_at_their_bounds():
    loss = _loss()
    last = loss.actor_network_params["module", "0", "module", "2"].data
    last["weight"].zero_()
    assert loss(_batch(8))["saturated_fraction"] == 0
    last["bias"].copy_(torch.tensor([0.0, 5.0]))
    assert loss(_batch(8))["saturated_fraction"] == 0.5


# --- Agreement with TorchRL's TD3Loss.


@pytest.mark.parametrize("delayed", [True, False])
@pytest.mark.parametrize("selection", ["utility", "elementwise"])
def test_one_objective_equals_td3(delayed, selection):
    actor, critic = _networks(num_objectives=1, num_tunable=1)
    losses = []
    kwargs = {"action_spec": SPEC, "delay_actor": delayed, "delay_qvalue": delayed}
    for cls, extra in ((TD3Loss, {}), (MOTD3Loss, {"target_selection": selection})):
        torch.manual_seed(7)
        losses.append(cls(copy.deepcopy(actor), copy.deepcopy(critic), **kwargs, **extra))
    batch = _batch(32, num_objectives=1, num_tunable=1)
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


@pytest.mark.parametrize("angle", ["normalized", "official"])
def test_each_loss_trains_its_own_network(angle):
    loss = _loss(angle=angle)
    actor = list(loss.actor_network_params.parameters())
    critic = list(loss.qvalue_network_params.parameters())
    batch = _batch(16)
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
    loss, batch = _loss(), _batch(16)
    gradients = []
    for coefficient in (0.0, 1.0):
        loss.angle_coeff_actor = loss.angle_coeff_critic = coefficient
        loss.zero_grad()
        out = _seeded(loss, batch)
        (out["loss_actor"] + out["loss_qvalue"]).backward()
        gradients.append([p.grad.clone() for p in loss.parameters()])
    assert not any(torch.allclose(off, on) for off, on in zip(*gradients))


def test_interpolator_is_saved_but_not_trained():
    loss = _loss()
    names = [name for name in loss.state_dict() if name.startswith("interpolator.")]
    assert "interpolator.coefficients" in names
    assert not any(name.startswith("interpolator") for name, _ in loss.named_parameters())


def test_state_dict_round_trip():
    loss, other = (
        _loss(),
        _loss(angle_coeff_actor=0.9, interpolator=PreferenceInterpolator(torch.eye(2))),
    )
    batch = _batch(16)
    expected = _seeded(loss, batch)
    assert not torch.allclose(_seeded(other, batch)["loss_actor"], expected["loss_actor"])
    other.load_state_dict(loss.state_dict())
    torch.testing.assert_close(_seeded(other, batch), expected)


def test_coefficients_are_scheduled_in_place():
    loss = _loss(angle_coeff_actor=1, angle_coeff_critic=0, pre_tanh_coeff=0)
    batch = _batch(16)
    buffer = loss.angle_coeff_actor
    before = loss.actor_loss(batch)
    loss.angle_coeff_actor = 1.25
    after = loss.actor_loss(batch)
    assert loss.angle_coeff_actor is buffer
    torch.testing.assert_close(after[0] - before[0], 0.25 * before[1]["angle"].mean())
    loss.pre_tanh_coeff = 0.5
    assert loss.actor_loss(batch)[0] > after[0]


def test_soft_update_moves_the_targets():
    loss = _loss()
    updater = SoftUpdate(loss, tau=0.5)
    loss.qvalue_network_params.data.add_(1.0)
    target = loss.target_qvalue_network_params["module", "0", "bias"].clone()
    updater.step()
    moved = loss.target_qvalue_network_params["module", "0", "bias"]
    torch.testing.assert_close(moved, target + 0.5)


def test_reset_parameters_recursive():
    loss = _loss()
    parameters = [p.clone() for p in loss.actor_network_params.values(True, True)]
    interpolator = loss.interpolator.coefficients.clone()
    loss.reset_parameters_recursive()
    first = loss.actor_network_params["module", "0", "module", "0", "weight"]
    assert not any(first.shape == p.shape and torch.equal(first, p) for p in parameters)
    assert torch.equal(loss.interpolator.coefficients, interpolator)
    assert loss(_batch(4))["loss_actor"].isfinite()


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
    loss.value_loss(_batch(8))[0].backward()
    assert trunk.module.weight.grad is None
    loss.actor_loss(_batch(8))[0].backward()
    assert (trunk.module.weight.grad != 0).any()


# --- The contract of a loss module.


@pytest.mark.parametrize("angle", [None, "normalized", "official"])
def test_out_keys_list_what_is_written(angle):
    coefficients = {} if angle else {"angle_coeff_actor": 0.0, "angle_coeff_critic": 0.0}
    loss = _loss(angle=angle, **coefficients)
    assert set(loss(_batch(4)).keys()) == set(loss.out_keys)
    assert ("angle" in loss.out_keys) == (angle is not None)


def test_metadata_shapes_and_no_graph():
    out = _loss()(_batch(5))
    shapes = {key: tuple(value.shape) for key, value in out.items() if not key.startswith("loss_")}
    assert shapes == {
        "state_action_value_actor": (5,),
        "saturated_fraction": (),
        "angle": (5,),
        "next_state_value": (5,),
        "pred_value": (2, 5),
        "target_value": (5,),
        "q_scale": (3,),
    }
    assert not any(out[key].requires_grad for key in shapes)


@pytest.mark.parametrize(
    "estimator", [ValueEstimators.TD0, ValueEstimators.TD1, ValueEstimators.TDLambda]
)
def test_value_estimators_work_objective_by_objective(estimator):
    batch = _batch(4, 6)
    done = batch["next", "done"]

    def target(reward: torch.Tensor, preference: torch.Tensor) -> torch.Tensor:
        num_objectives = reward.shape[-1]
        td = batch.clone()
        td["preference"] = td["next", "preference"] = preference.expand(4, 6, num_objectives)
        td["next", "reward"] = reward
        actor = make_actor(SPEC, in_features=OBS, in_keys=["observation"], num_cells=(8,))
        critic = make_vector_critic(
            num_objectives, in_features=OBS, in_keys=["observation"], num_cells=()
        )
        loss = MOTD3Loss(actor, critic, action_spec=SPEC)
        loss.target_qvalue_network_params.data.apply_(lambda p: p.fill_(0.3))
        loss.make_value_estimator(estimator, gamma=0.9)
        return loss.value_loss(td)[1]["target_value"]

    assert done.any() and not done.all()
    reward = batch["next", "reward"]
    for objective, one_hot in enumerate(torch.eye(3)):
        alone = target(reward[..., objective : objective + 1], torch.ones(1))
        torch.testing.assert_close(target(reward, one_hot), alone)


@pytest.mark.parametrize("num_nets", [1, 2, 3])
@pytest.mark.parametrize("selection", ["utility", "elementwise"])
def test_number_of_critics_and_vmap(num_nets, selection):
    outs = []
    for deactivate_vmap in (False, True):
        torch.manual_seed(0)
        loss = _loss(
            num_qvalue_nets=num_nets, target_selection=selection, deactivate_vmap=deactivate_vmap
        )
        outs.append(_seeded(loss, _batch(8)))
    assert outs[0]["pred_value"].shape == (num_nets, 8)
    torch.testing.assert_close(outs[0], outs[1])


def test_list_of_critics_keeps_its_initialisation():
    actor, first = _networks()
    _, second = _networks()
    loss = MOTD3Loss(actor, [first, second], preference_space=SPACE, action_spec=SPEC)
    weight = loss.qvalue_network_params["module", "0", "weight"]
    assert torch.equal(weight, torch.stack([first.module[0].weight, second.module[0].weight]))


def test_reductions_agree():
    batch = _batch(8)
    loss = _loss(reduction="none")
    none = _seeded(loss, batch)
    for key in ("loss_actor", "loss_qvalue"):
        assert none[key].shape == (8,)
        loss.reduction = "mean"
        torch.testing.assert_close(_seeded(loss, batch)[key], none[key].mean())
        loss.reduction = "sum"
        torch.testing.assert_close(_seeded(loss, batch)[key], none[key].sum())


def test_importance_weights():
    batch = _batch(8)
    loss = _loss(reduction="none")
    none = _seeded(loss, batch)
    weights = torch.rand(8)
    batch["priority_weight"] = weights
    loss.reduction = "mean"
    weighted = _seeded(loss, batch)
    for key in ("loss_actor", "loss_qvalue"):
        expected = (none[key] * weights).sum() / weights.sum()
        torch.testing.assert_close(weighted[key], expected)
    loss.use_prioritized_weights = False
    torch.testing.assert_close(_seeded(loss, batch)["loss_actor"], none["loss_actor"].mean())


def test_padding_is_masked():
    batch = _batch(2, 3)
    loss = _loss(reduction="none", policy_noise=0.0)
    none = _seeded(loss, batch)
    mask = torch.tensor([[True, True, False], [True, False, False]])
    batch["collector", "mask"] = mask.unsqueeze(-1)
    loss.reduction = "mean"
    masked = _seeded(loss, batch)
    for key in ("loss_actor", "loss_qvalue"):
        torch.testing.assert_close(masked[key], none[key][mask].mean())


def test_batch_of_two_dimensions_equals_the_flat_batch():
    loss = _loss(policy_noise=0.0)
    batch = _batch(4, 3)
    square, flat = batch.clone(), batch.reshape(-1).clone()
    outs = [loss(square), loss(flat)]
    for key in ("loss_actor", "loss_qvalue", "q_scale", "saturated_fraction"):
        torch.testing.assert_close(outs[0][key], outs[1][key])
    assert square["td_error"].shape == (4, 3)
    torch.testing.assert_close(square["td_error"].reshape(-1), flat["td_error"])
    assert outs[0]["pred_value"].shape == (2, 4, 3)


def test_batch_is_not_changed_but_for_the_priority():
    batch = _batch(5)
    before = batch.clone()
    _loss()(batch)
    assert batch.pop("td_error").shape == (5,)
    assert set(batch.keys(True)) == set(before.keys(True))
    assert (batch == before).all()


def test_default_keys():
    keys = MOTD3Loss.default_keys()
    assert (keys.preference, keys.pre_tanh) == ("preference", "pre_tanh")
    assert (keys.action, keys.priority, keys.reward) == ("action", "td_error", "reward")


def test_keyword_arguments_instead_of_a_tensordict():
    batch = _batch(5)
    loss = _loss()
    expected = _seeded(loss, batch)
    flat = batch.flatten_keys("_")
    torch.manual_seed(1)
    out = loss(**dict(flat.items()))
    assert len(out) == len(loss.out_keys)
    for key, value in zip(loss.out_keys, out):
        torch.testing.assert_close(value, expected[key])
    loss.select_out_keys("loss_actor", "loss_qvalue")
    torch.manual_seed(1)
    actor, qvalue = loss(**dict(flat.items()))
    torch.testing.assert_close(actor, expected["loss_actor"])
    torch.testing.assert_close(qvalue, expected["loss_qvalue"])


def test_nested_keys():
    torch.manual_seed(0)
    flat_loss = _loss()
    torch.manual_seed(0)
    actor = make_actor(
        SPEC,
        in_features=OBS + 2,
        in_keys=[("agent", "observation"), ("user", "wish")],
        num_cells=(16,),
        last_layer_gain=1.0,
        out_key=("agent", "act"),
        pre_tanh_key=("agent", "logit"),
    )
    critic = make_vector_critic(
        3,
        in_features=OBS + 2 + ACT,
        in_keys=[("agent", "observation"), ("user", "wish"), ("agent", "act")],
        out_key=("agent", "value"),
        num_cells=(16,),
    )
    loss = MOTD3Loss(
        actor,
        critic,
        preference_space=SPACE,
        interpolator=_interpolator(),
        angle="normalized",
        angle_coeff_actor=0.3,
        angle_coeff_critic=0.2,
        pre_tanh_coeff=0.1,
        action_spec=SPEC,
    )
    loss.set_keys(
        action=("agent", "act"),
        state_action_value=("agent", "value"),
        preference=("user", "wish"),
        pre_tanh=("agent", "logit"),
        reward=("agent", "gain"),
        done=("agent", "over"),
        terminated=("agent", "dead"),
        priority=("agent", "surprise"),
    )
    batch = _batch(6)
    nested = TensorDict(batch_size=6)
    renamed = {
        "observation": ("agent", "observation"),
        "preference": ("user", "wish"),
        "action": ("agent", "act"),
        "reward": ("agent", "gain"),
        "done": ("agent", "over"),
        "terminated": ("agent", "dead"),
    }
    for key, value in batch.items(True, True):
        path = ("next", *renamed[key[1]]) if isinstance(key, tuple) else renamed[key]
        nested.set(path, value)
    assert set(loss.in_keys) == set(nested.keys(True, True))
    expected = _seeded(flat_loss, batch)
    torch.manual_seed(1)
    out = loss(nested)
    torch.testing.assert_close(out, expected)
    assert nested["agent", "surprise"].shape == (6,)
    # A preference that is stored once: nothing of ("next", "user") is left.
    del nested["next", "user"]
    torch.manual_seed(1)
    torch.testing.assert_close(loss(nested), expected)
    loss.set_keys(preference=None)
    assert loss.tensor_keys.preference == "preference"


def test_action_spec_may_be_a_composite():
    loss = _loss(action_spec=Composite(action=SPEC))
    assert torch.equal(loss.max_action, SPEC.space.high)


def test_critic_may_see_more_than_the_actor():
    actor = make_actor(SPEC, in_features=OBS, in_keys=["observation"], num_cells=(8,))
    critic = TensorDictModule(
        _Table(torch.eye(3).tolist()), in_keys=["privileged"], out_keys=["state_action_value"]
    )
    loss = MOTD3Loss(actor, [critic], num_qvalue_nets=1, preference_space=SPACE, action_spec=SPEC)
    batch = _batch(5)
    batch["privileged"] = torch.randn(5, 3)
    batch["next", "privileged"] = torch.randn(5, 3)
    assert {"privileged", ("next", "privileged")} <= set(loss.in_keys)
    out = loss(batch)
    weights = SPACE.weights(batch["preference"])
    now, later = batch["privileged"], batch["next", "privileged"]
    torch.testing.assert_close(out["state_action_value_actor"], (weights * now).sum(-1))
    torch.testing.assert_close(out["next_state_value"], (weights * later).sum(-1))


def test_preference_of_the_next_state():
    loss = _loss(angle=None, angle_coeff_actor=0.0, angle_coeff_critic=0.0)
    batch = _batch(8)
    expected = _seeded(loss, batch)["next_state_value"]
    once = batch.clone()
    del once["next", "preference"]
    torch.testing.assert_close(_seeded(loss, once)["next_state_value"], expected)
    changed = batch.clone()
    changed["next", "preference"] = batch["preference"].flip(-1)
    assert not torch.allclose(_seeded(loss, changed)["next_state_value"], expected)


def test_without_vmap_the_losses_are_the_same():
    batch = _batch(8)
    results = []
    for deactivate_vmap in (False, True):
        torch.manual_seed(0)
        loss = _loss(deactivate_vmap=deactivate_vmap)
        out = _seeded(loss, batch)
        (out["loss_actor"] + out["loss_qvalue"]).backward()
        gradients = {name: parameter.grad for name, parameter in loss.named_parameters()}
        results.append((out.to_dict(), gradients))
    torch.testing.assert_close(*results)


@pytest.mark.parametrize("angle", ["normalized", "official"])
@pytest.mark.parametrize("deactivate_vmap", [False, True])
def test_compiles_to_one_graph(angle, deactivate_vmap):
    loss = _loss(angle=angle, deactivate_vmap=deactivate_vmap)
    SoftUpdate(loss, tau=0.1)
    batch = _batch(8)
    expected = _seeded(loss, batch)

    @torch.compile(fullgraph=True, backend="eager")
    def update(td: TensorDict):
        actor, metadata = loss.actor_loss(td)
        value, value_metadata = loss.value_loss(td)
        return actor, value, metadata, value_metadata

    torch.manual_seed(1)
    actor, value, metadata, value_metadata = update(batch.clone())
    torch.testing.assert_close(actor, expected["loss_actor"])
    torch.testing.assert_close(value, expected["loss_qvalue"])
    for key, result in (metadata | value_metadata).items():
        if key != "td_error":
            torch.testing.assert_close(result, expected[key])
    loss.angle_coeff_actor = 0.7
    loss.interpolator.refit(torch.tensor([[0.5, -1.0], [-2.0, 0.5]]))
    rescheduled = update(batch.clone())[0]
    torch.testing.assert_close(rescheduled, loss.actor_loss(batch)[0])
    assert not torch.allclose(rescheduled, actor)


def test_learns_to_follow_the_preference():
    # One step, two goals: the rewards are the distances to actions -1 and 1, so the best action for
    # (lambda, 1 - lambda) is 1 - 2 lambda.
    spec = Bounded(-2.0, 2.0, (1,))
    space = PreferenceSpace(("left", "right"))
    loss = MOTD3Loss(
        make_actor(spec, in_features=2, in_keys=["preference"], num_cells=(32,)),
        make_vector_critic(2, in_features=3, in_keys=["preference", "action"], num_cells=(32, 32)),
        preference_space=space,
        action_spec=spec,
    )
    SoftUpdate(loss, tau=0.05)
    optimizer = torch.optim.Adam(loss.parameters(), lr=5e-3)
    for _ in range(300):
        action = spec.rand((128,))
        done = torch.ones(128, 1, dtype=torch.bool)
        reward = torch.cat([-((action + 1) ** 2), -((action - 1) ** 2)], -1)
        batch = TensorDict(
            preference=space.sample(128),
            action=action,
            next=TensorDict(reward=reward, done=done, terminated=done, batch_size=128),
            batch_size=128,
        )
        out = loss(batch)
        (out["loss_actor"] + out["loss_qvalue"]).backward()
        optimizer.step()
        optimizer.zero_grad()
    share = torch.tensor([0.0, 0.25, 0.5, 0.75, 1.0])
    actor = loss.get_stateful_net("actor_network")
    data = TensorDict(preference=torch.stack([share, 1 - share], -1), batch_size=5)
    torch.testing.assert_close(
        actor(data)["action"].squeeze(-1), 1 - 2 * share, atol=0.25, rtol=0.0
    )


# --- Bad arguments.


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"angle": "degrees"}, "angle must be None or one of"),
        ({"angle": None}, "no effect without angle"),
        ({"interpolator": None}, "needs an interpolator"),
        ({"interpolator": PreferenceInterpolator(torch.eye(3))}, "3 tunable objectives"),
        ({"angle_coeff_actor": -1.0}, "angle_coeff_actor must not be negative"),
        ({"pre_tanh_coeff": -1.0}, "pre_tanh_coeff must not be negative"),
        ({"target_selection": "median"}, "target_selection must be one of"),
        ({"action_spec": None}, "bounds"),
    ],
)
def test_bad_constructor_arguments(kwargs, message):
    with pytest.raises(ValueError, match=message):
        _loss(**kwargs)


def test_unknown_key():
    with pytest.raises(ValueError, match="not an accepted tensordict key"):
        _loss().set_keys(weight="w")


@pytest.mark.parametrize("method", ["actor_loss", "value_loss"])
def test_preference_without_its_space(method):
    loss = MOTD3Loss(*_networks(), action_spec=SPEC)
    with pytest.raises(ValueError, match="gives 2 weights, the critic 3 values"):
        getattr(loss, method)(_batch(4))


def test_one_weight_does_not_broadcast_over_the_objectives():
    loss = MOTD3Loss(*_networks(num_objectives=3, num_tunable=1), action_spec=SPEC)
    with pytest.raises(ValueError, match="gives 1 weights, the critic 3 values"):
        loss(_batch(4, num_tunable=1))


@pytest.mark.parametrize("num_rewards", [1, 4])
def test_reward_of_the_wrong_length(num_rewards):
    with pytest.raises(ValueError, match="one entry per objective"):
        _loss()(_batch(4, num_objectives=num_rewards))


def test_pre_tanh_penalty_without_a_pre_tanh_output():
    loss = _loss()
    loss.set_keys(pre_tanh="logit")
    with pytest.raises(KeyError, match="pre_tanh_coeff needs the actor to write 'logit'"):
        loss(_batch(4))


def test_missing_preference():
    batch = _batch(4).exclude("preference", ("next", "preference"))
    with pytest.raises(KeyError, match="preference"):
        _loss()(batch)
