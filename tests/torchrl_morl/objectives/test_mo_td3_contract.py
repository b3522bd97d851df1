"""Multi-objective TD3 as a loss module of TorchRL: keys, shapes, reductions, compilation."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Bounded, Composite
from torchrl.objectives import SoftUpdate
from torchrl.objectives.utils import ValueEstimators

from tests._mo_td3 import (
    ACT,
    OBS,
    SPACE,
    SPEC,
    make_batch,
    make_interpolator,
    make_loss,
    make_networks,
    seeded,
)
from torchrl_morl.modules import make_actor, make_vector_critic
from torchrl_morl.objectives import MOTD3Loss
from torchrl_morl.preferences import PreferenceSpace

# --- The contract of a loss module.


@pytest.mark.parametrize("angle", [None, "normalized", "raw"])
def test_out_keys_list_what_is_written(angle):
    coefficients = {} if angle else {"angle_coeff_actor": 0.0, "angle_coeff_critic": 0.0}
    loss = make_loss(angle=angle, **coefficients)
    assert set(loss(make_batch(4)).keys()) == set(loss.out_keys)
    assert ("angle" in loss.out_keys) == (angle is not None)


def test_metadata_shapes_and_no_graph():
    out = make_loss()(make_batch(5))
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
    batch = make_batch(4, 6)
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
        loss = make_loss(
            num_qvalue_nets=num_nets, target_selection=selection, deactivate_vmap=deactivate_vmap
        )
        outs.append(seeded(loss, make_batch(8)))
    assert outs[0]["pred_value"].shape == (num_nets, 8)
    torch.testing.assert_close(outs[0], outs[1])


def test_list_of_critics_keeps_its_initialisation():
    actor, first = make_networks()
    _, second = make_networks()
    loss = MOTD3Loss(actor, [first, second], preference_space=SPACE, action_spec=SPEC)
    weight = loss.qvalue_network_params["module", "0", "weight"]
    assert torch.equal(weight, torch.stack([first.module[0].weight, second.module[0].weight]))


def test_reductions_agree():
    batch = make_batch(8)
    loss = make_loss(reduction="none")
    none = seeded(loss, batch)
    for key in ("loss_actor", "loss_qvalue"):
        assert none[key].shape == (8,)
        loss.reduction = "mean"
        torch.testing.assert_close(seeded(loss, batch)[key], none[key].mean())
        loss.reduction = "sum"
        torch.testing.assert_close(seeded(loss, batch)[key], none[key].sum())


def test_importance_weights():
    batch = make_batch(8)
    loss = make_loss(reduction="none")
    none = seeded(loss, batch)
    weights = torch.rand(8)
    batch["priority_weight"] = weights
    loss.reduction = "mean"
    weighted = seeded(loss, batch)
    for key in ("loss_actor", "loss_qvalue"):
        expected = (none[key] * weights).sum() / weights.sum()
        torch.testing.assert_close(weighted[key], expected)
    loss.use_prioritized_weights = False
    torch.testing.assert_close(seeded(loss, batch)["loss_actor"], none["loss_actor"].mean())


def test_padding_is_masked():
    batch = make_batch(2, 3)
    loss = make_loss(reduction="none", policy_noise=0.0)
    none = seeded(loss, batch)
    mask = torch.tensor([[True, True, False], [True, False, False]])
    batch["collector", "mask"] = mask.unsqueeze(-1)
    loss.reduction = "mean"
    masked = seeded(loss, batch)
    for key in ("loss_actor", "loss_qvalue"):
        torch.testing.assert_close(masked[key], none[key][mask].mean())


def test_batch_of_two_dimensions_equals_the_flat_batch():
    loss = make_loss(policy_noise=0.0)
    batch = make_batch(4, 3)
    square, flat = batch.clone(), batch.reshape(-1).clone()
    outs = [loss(square), loss(flat)]
    for key in ("loss_actor", "loss_qvalue", "q_scale", "saturated_fraction"):
        torch.testing.assert_close(outs[0][key], outs[1][key])
    assert square["td_error"].shape == (4, 3)
    torch.testing.assert_close(square["td_error"].reshape(-1), flat["td_error"])
    assert outs[0]["pred_value"].shape == (2, 4, 3)


def test_batch_is_not_changed_but_for_the_priority():
    batch = make_batch(5)
    before = batch.clone()
    make_loss()(batch)
    assert batch.pop("td_error").shape == (5,)
    assert set(batch.keys(True)) == set(before.keys(True))
    assert (batch == before).all()


def test_default_keys():
    keys = MOTD3Loss.default_keys()
    assert (keys.preference, keys.pre_tanh) == ("preference", "pre_tanh")
    assert (keys.action, keys.priority, keys.reward) == ("action", "td_error", "reward")


def test_keyword_arguments_instead_of_a_tensordict():
    batch = make_batch(5)
    loss = make_loss()
    expected = seeded(loss, batch)
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
    flat_loss = make_loss()
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
        interpolator=make_interpolator(),
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
    batch = make_batch(6)
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
    expected = seeded(flat_loss, batch)
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
    loss = make_loss(action_spec=Composite(action=SPEC))
    assert torch.equal(loss.max_action, SPEC.space.high)


def test_critic_may_see_more_than_the_actor():
    actor = make_actor(SPEC, in_features=OBS, in_keys=["observation"], num_cells=(8,))
    identity = nn.Linear(3, 3, bias=False)
    nn.init.eye_(identity.weight)
    critic = TensorDictModule(identity, in_keys=["privileged"], out_keys=["state_action_value"])
    loss = MOTD3Loss(actor, [critic], num_qvalue_nets=1, preference_space=SPACE, action_spec=SPEC)
    batch = make_batch(5)
    batch["privileged"] = torch.randn(5, 3)
    batch["next", "privileged"] = torch.randn(5, 3)
    assert {"privileged", ("next", "privileged")} <= set(loss.in_keys)
    out = loss(batch)
    weights = SPACE.weights(batch["preference"])
    now, later = batch["privileged"], batch["next", "privileged"]
    torch.testing.assert_close(out["state_action_value_actor"], (weights * now).sum(-1))
    torch.testing.assert_close(out["next_state_value"], (weights * later).sum(-1))


def test_preference_of_the_next_state():
    loss = make_loss(angle=None, angle_coeff_actor=0.0, angle_coeff_critic=0.0)
    batch = make_batch(8)
    expected = seeded(loss, batch)["next_state_value"]
    once = batch.clone()
    del once["next", "preference"]
    torch.testing.assert_close(seeded(loss, once)["next_state_value"], expected)
    changed = batch.clone()
    changed["next", "preference"] = batch["preference"].flip(-1)
    assert not torch.allclose(seeded(loss, changed)["next_state_value"], expected)


def test_without_vmap_the_losses_are_the_same():
    batch = make_batch(8)
    results = []
    for deactivate_vmap in (False, True):
        torch.manual_seed(0)
        loss = make_loss(deactivate_vmap=deactivate_vmap)
        out = seeded(loss, batch)
        (out["loss_actor"] + out["loss_qvalue"]).backward()
        gradients = {name: parameter.grad for name, parameter in loss.named_parameters()}
        results.append((out.to_dict(), gradients))
    torch.testing.assert_close(*results)


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("loss_function", ["smooth_l1", "l2"])
def test_mixed_precision(loss_function, compiled):
    # Without the noise of the target only what lies between first and last layer differs.
    torch.manual_seed(0)
    loss = make_loss(
        num_cells=(16, 16),
        loss_function=loss_function,
        deactivate_vmap=compiled,
        policy_noise=0.0,
    )
    SoftUpdate(loss, tau=0.1)
    batch = make_batch(64)

    def gradients(losses: list[torch.Tensor]) -> dict[str, torch.Tensor]:
        loss.zero_grad()
        sum(losses).backward()
        return {name: p.grad for name, p in loss.named_parameters() if p.grad is not None}

    def run(td: TensorDict) -> list[torch.Tensor]:
        return [loss.actor_loss(td)[0], loss.value_loss(td)[0]]

    exact = run(batch.clone())
    expected = gradients(exact)
    rounding = torch.compile(run, fullgraph=True, backend="eager") if compiled else run
    with torch.autocast("cpu", torch.bfloat16):
        rounded = rounding(batch.clone())
    assert all(value.dtype == torch.float32 for value in rounded)
    torch.testing.assert_close(rounded, exact, rtol=0.02, atol=0.01)
    assert not torch.equal(rounded[1], exact[1])
    found = gradients(rounded)
    assert found.keys() == expected.keys()
    for name, gradient in found.items():
        assert torch.cosine_similarity(gradient.flatten(), expected[name].flatten(), dim=0) > 0.98


@pytest.mark.parametrize("angle", ["normalized", "raw"])
@pytest.mark.parametrize("deactivate_vmap", [False, True])
def test_compiles_to_one_graph(angle, deactivate_vmap):
    loss = make_loss(angle=angle, deactivate_vmap=deactivate_vmap)
    SoftUpdate(loss, tau=0.1)
    batch = make_batch(8)
    expected = seeded(loss, batch)

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
    preference_space = PreferenceSpace(("left", "right"))
    loss = MOTD3Loss(
        make_actor(spec, in_features=2, in_keys=["preference"], num_cells=(32,)),
        make_vector_critic(2, in_features=3, in_keys=["preference", "action"], num_cells=(32, 32)),
        preference_space=preference_space,
        action_spec=spec,
    )
    SoftUpdate(loss, tau=0.05)
    optimizer = torch.optim.Adam(loss.parameters(), lr=5e-3)
    for _ in range(300):
        action = spec.rand((128,))
        done = torch.ones(128, 1, dtype=torch.bool)
        reward = torch.cat([-((action + 1) ** 2), -((action - 1) ** 2)], -1)
        batch = TensorDict(
            preference=preference_space.sample(128),
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
