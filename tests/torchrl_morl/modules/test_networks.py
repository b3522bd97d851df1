"""Actor and critic builders, and the saturation metric."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import DoubleToFloat, TransformedEnv
from torchrl.modules import MLP

from torchrl_morl.modules import RewardModel, make_actor, make_vector_critic, saturated_fraction
from torchrl_morl.preferences import PreferenceSpace
from torchrl_morl.testing import VectorRewardMockEnv
from torchrl_morl.transforms import PreferenceSampler

LOW, HIGH = torch.tensor([0.0, -3.0]), torch.tensor([0.5, 3.0])


def _data(*batch: int, scale: float = 1.0) -> TensorDict:
    return TensorDict(
        observation=scale * torch.randn(*batch, 4),
        preference=torch.rand(*batch, 3),
        action=torch.rand(*batch, 2),
        batch_size=batch,
    )


@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
def test_actor_maps_the_pre_tanh_output_to_the_bounds(batch):
    actor = make_actor(Bounded(LOW, HIGH), in_features=7, num_cells=(8, 8), last_layer_gain=50.0)
    data = actor(_data(*batch, scale=100.0))
    assert data["action"].shape == (*batch, 2)
    expected = LOW + (HIGH - LOW) * (data["pre_tanh"].tanh() + 1) / 2
    torch.testing.assert_close(data["action"], expected)
    assert Bounded(LOW, HIGH).expand(*batch, 2).is_in(data["action"])


def test_actor_starts_at_the_centre_of_the_range():
    actor = make_actor(Bounded(LOW, HIGH), in_features=7, last_layer_gain=0.01)
    action = actor(_data(64))["action"]
    distance = (action - (LOW + HIGH) / 2).abs() / (HIGH - LOW)
    assert distance.max() < 0.01
    assert action.std(0).min() > 0
    loose = make_actor(Bounded(LOW, HIGH), in_features=7, last_layer_gain=1.0)
    assert loose[0].module[-1].weight.abs().max() > actor[0].module[-1].weight.abs().max() * 10


def test_reset_keeps_the_small_last_layer():
    actor = make_actor(Bounded(LOW, HIGH), in_features=7, num_cells=(8,), last_layer_gain=0.01)
    before = {name: value.clone() for name, value in actor.named_parameters()}
    actor.reset_parameters_recursive()
    last = actor[0].module[-1]
    assert not torch.equal(last.weight, before["module.0.module.2.weight"])
    assert last.weight.abs().max() <= 0.01 / 8**0.5
    assert (last.bias == 0).all()


def test_actor_sees_the_preference():
    actor = make_actor(Bounded(LOW, HIGH), in_features=7, last_layer_gain=1.0)
    data = _data(1).expand(2).clone()
    data["preference"] = torch.eye(3)[:2]
    action = actor(data)["action"]
    assert not torch.allclose(action[0], action[1])


def test_actor_nested_keys_and_composite_spec():
    spec = Composite({"agent": Composite({"action": Bounded(LOW, HIGH)})})
    actor = make_actor(
        spec,
        in_features=7,
        in_keys=[("agent", "observation"), ("agent", "preference")],
        out_key=("agent", "action"),
        pre_tanh_key=("agent", "pre_tanh"),
        num_cells=(8,),
    )
    data = TensorDict(agent=_data(5).exclude("action"), batch_size=5)
    assert actor(data)["agent", "action"].shape == (5, 2)
    assert data["agent", "pre_tanh"].shape == (5, 2)
    assert actor.in_keys == [("agent", "observation"), ("agent", "preference")]


def test_actor_drops_the_batch_of_the_spec():
    actor = make_actor(Bounded(LOW, HIGH).expand(6, 2), in_features=7, num_cells=(8,))
    assert torch.equal(actor[1].action_low, LOW)
    assert torch.equal(actor[1].action_high, HIGH)


@pytest.mark.parametrize("layer_norm", [True, False])
@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
def test_critic_writes_one_value_per_objective(batch, layer_norm):
    critic = make_vector_critic(4, in_features=9, num_cells=(8, 8), layer_norm=layer_norm)
    assert critic(_data(*batch))["state_action_value"].shape == (*batch, 4)
    assert any(isinstance(module, nn.LayerNorm) for module in critic.modules()) == layer_norm


def test_critic_depends_on_every_input():
    critic = make_vector_critic(2, in_features=9, num_cells=(8,))
    data = _data(5)
    for value in data.values():
        value.requires_grad_()
    critic(data)["state_action_value"].sum().backward()
    for key in critic.in_keys:
        assert (data[key].grad != 0).any(), key


def test_critic_keys():
    critic = make_vector_critic(
        2,
        in_features=6,
        in_keys=[("agent", "observation"), "action"],
        out_key=("agent", "value"),
        num_cells=(8,),
    )
    data = TensorDict(agent=_data(5).select("observation"), action=torch.rand(5, 2), batch_size=5)
    assert critic(data)["agent", "value"].shape == (5, 2)


def test_a_seed_gives_the_critic_that_its_layers_would_have():
    torch.manual_seed(0)
    critic = make_vector_critic(4, in_features=9, num_cells=(8,))
    after = torch.rand(())
    torch.manual_seed(0)
    layers = MLP(in_features=9, out_features=4, num_cells=[8])
    torch.testing.assert_close(after, torch.rand(()))
    for index in (0, -1):
        torch.testing.assert_close(critic.module[index].weight, layers[index].weight)
        torch.testing.assert_close(critic.module[index].bias, layers[index].bias)


def test_state_dict_keys_are_stable():
    # Published weights are stored under these names.
    actor = make_actor(Bounded(LOW, HIGH), in_features=7, num_cells=(8, 8))
    layers = [f"module.0.module.{i}.{name}" for i in (0, 2, 4) for name in ("weight", "bias")]
    assert list(actor.state_dict()) == [*layers, "module.1.action_low", "module.1.action_high"]
    critic = make_vector_critic(4, in_features=9, num_cells=(8,))
    layers = [f"module.{i}.{name}" for i in (0, 1, 3) for name in ("weight", "bias")]
    assert list(critic.state_dict()) == layers


def _networks(num_cells: tuple[int, ...]):
    bounds = Bounded(-1.0, 1.0, (2,))
    return (
        make_actor(bounds, in_features=7, num_cells=num_cells, last_layer_gain=1.0),
        make_vector_critic(4, in_features=9, num_cells=num_cells),
    )


@pytest.mark.parametrize("num_cells", [(), (8,)])
def test_inputs_keep_their_digits_under_autocast(num_cells):
    """There is no other layer yet: nothing is rounded."""
    data = _data(50)
    for network in _networks(num_cells):
        exact = network(data.clone())
        with torch.autocast("cpu", torch.bfloat16):
            rounded = network(data.clone())
        for key in network.out_keys:
            assert torch.equal(rounded[key], exact[key])


def test_outputs_keep_their_digits_under_autocast():
    torch.manual_seed(0)
    actor, critic = _networks(num_cells=(8, 8))
    data = _data(50)
    for network in (actor, critic):
        exact = network(data.clone())
        with torch.autocast("cpu", torch.bfloat16):
            rounded = network(data.clone())
        for key in network.out_keys:
            assert rounded[key].dtype == torch.float32
            # Of bfloat16 are the hidden layers, and not what comes after them.
            assert not torch.equal(rounded[key], exact[key])
            assert not torch.equal(rounded[key], rounded[key].bfloat16().float())
            torch.testing.assert_close(rounded[key], exact[key], atol=0.02, rtol=0.02)


@pytest.mark.parametrize("threshold", [0.99, 0.4])
def test_saturated_fraction(threshold):
    action = torch.tensor([[0.0, 0.0], [0.5, 2.985], [0.25, -1.8], [0.001, 2.9]])
    # Scaled to [-1, 1]: (-1, 0), (1, .995), (0, -.6), (-.996, .967).
    expected = {0.99: 4 / 8, 0.4: 6 / 8}[threshold]
    assert saturated_fraction(action, LOW, HIGH, threshold=threshold) == expected


def test_saturated_fraction_of_a_pre_tanh_output():
    pre_tanh = torch.tensor([[-10.0, 1.0], [2.0, 3.0]], requires_grad=True)
    fraction = saturated_fraction(pre_tanh.tanh())
    assert fraction == 0.5
    assert not fraction.requires_grad


def test_bad_arguments():
    with pytest.raises(ValueError, match="must be a Bounded spec"):
        make_actor(Unbounded((2,)), in_features=7)
    with pytest.raises(ValueError, match="must be a Bounded spec"):
        make_actor(Bounded(0.0, 1.0, ()), in_features=7)
    spec = Bounded(torch.tensor([[0.0], [-1.0]]), torch.ones(2, 1))
    with pytest.raises(ValueError, match="different bounds"):
        make_actor(spec, in_features=7)
    with pytest.raises(ValueError, match="num_objectives must be at least 1"):
        make_vector_critic(0, in_features=9)


# --- Specs in, sizes out.

WISHES = PreferenceSpace(("a", "b", "c"))


def mock_env(batch_size=(4,), prefix=None) -> TransformedEnv:
    key = "preference" if prefix is None else (prefix, "preference")
    env = VectorRewardMockEnv(3, batch_size=batch_size, prefix=prefix)
    return TransformedEnv(env, PreferenceSampler(WISHES, preference_key=key))


@pytest.mark.parametrize("batch_size", [(), (4,), (2, 3)])
@pytest.mark.parametrize("composite", [False, True])
def test_sizes_follow_from_the_specs(batch_size, composite):
    env = mock_env(batch_size)
    action_spec = env.full_action_spec if composite else env.action_spec
    actor = make_actor(action_spec, env.observation_spec, num_cells=(8,))
    critic = make_vector_critic(3, env.observation_spec, action_spec, num_cells=(8,))
    model = RewardModel(env.observation_spec, action_spec, num_cells=(8,))
    assert actor[0].module[0].in_features == 2 + 3
    assert critic.module[0].in_features == 2 + 3 + 2
    assert model.in_features == 2 + 2
    data = env.rollout(3, actor)
    assert critic(data)["state_action_value"].shape == (*batch_size, 3, 3)
    assert model(data)["demo_score"].shape == (*batch_size, 3, 1)


def test_sizes_of_nested_keys():
    env = mock_env(prefix="agent")
    keys = [("agent", "observation"), ("agent", "preference")]
    actor = make_actor(
        env.full_action_spec, env.observation_spec, in_keys=keys, out_key=("agent", "action")
    )
    assert actor[0].module[0].in_features == 2 + 3
    action = ("agent", "action")
    for spec in (env.full_action_spec, env.action_spec):
        critic = make_vector_critic(
            3, env.observation_spec, spec, in_keys=[*keys, action], action_key=action
        )
        assert critic.module[0].in_features == 2 + 3 + 2


def test_specs_and_sizes_that_do_not_do():
    env = mock_env()
    with pytest.raises(ValueError, match="give the specs of the environment or in_features=5: one"):
        make_actor(env.action_spec, env.observation_spec, in_features=5)
    with pytest.raises(ValueError, match="one of the two"):
        make_vector_critic(3)
    with pytest.raises(
        ValueError, match=r"'action' is not in the specs, which have \['observation'"
    ):
        make_vector_critic(3, env.observation_spec)
    bare = VectorRewardMockEnv(3)
    with pytest.raises(ValueError, match=r"'preference' is not in the specs.*PreferenceSampler"):
        make_actor(bare.action_spec, bare.observation_spec)
    flat = Composite(observation=Unbounded((4,)), shape=(4,))
    with pytest.raises(ValueError, match="'observation' has no dimension of features"):
        make_vector_critic(3, flat, in_keys=["observation"])


# --- Inputs that do not fit are named.


class DoubleEnv(VectorRewardMockEnv):
    """Observations in double precision, as those of MO-Gymnasium's MuJoCo tasks."""

    def __init__(self, **kwargs) -> None:
        super().__init__(3, **kwargs)
        self.observation_spec["observation"] = Bounded(
            -1.0, 1.0, shape=(*self.batch_size, 2), dtype=torch.float64
        )

    def _observe(self) -> TensorDict:
        data = super()._observe()
        return data.set("observation", data["observation"].double())


def test_double_observations_are_named_and_the_advice_works():
    env = TransformedEnv(DoubleEnv(batch_size=(4,)), PreferenceSampler(WISHES))
    actor = make_actor(env.action_spec, env.observation_spec, num_cells=(8,))
    critic = make_vector_critic(3, env.observation_spec, env.action_spec, num_cells=(8,))
    model = RewardModel(env.observation_spec, env.action_spec, num_cells=(8,))
    message = r"^'observation' is float64, the network float32: append DoubleToFloat\(\)"
    with pytest.raises(ValueError, match=message):
        env.rollout(3, actor)
    data = env.rollout(3)
    for network in (actor, critic, model):
        with pytest.raises(ValueError, match=message):
            network(data.clone())
        # A network of double precision takes the preference along, as concatenation does.
        assert network.double()(data.clone()) is not None
        network.float()
    env.append_transform(DoubleToFloat())
    assert critic(env.rollout(3, actor))["state_action_value"].dtype == torch.float32


def test_other_precisions_and_autocast():
    critic = make_vector_critic(3, in_features=9, num_cells=(8,))
    data = _data(4)
    with pytest.raises(ValueError, match="'observation' is float32, the network float64"):
        critic.double()(data.clone())
    critic.float()
    halves = data.apply(lambda value: value.half())
    with pytest.raises(ValueError, match="'observation' is float16, the network float32: convert"):
        critic(halves)
    with torch.autocast("cpu", torch.bfloat16):
        assert critic(data.double())["state_action_value"].dtype == torch.float32


def test_inputs_of_another_size_are_named():
    actor = make_actor(Bounded(LOW, HIGH), in_features=9, num_cells=(8,))
    with pytest.raises(
        ValueError, match=r"takes 9 entries, the inputs have 7: {'observation': 4, 'p"
    ):
        actor(_data(5))


def test_a_network_is_exported_as_before():
    mlp = make_vector_critic(3, in_features=9, num_cells=(8,)).module
    inputs = tuple(_data(5)[key] for key in ("observation", "preference", "action"))
    program = torch.export.export(mlp, inputs)
    torch.testing.assert_close(program.module()(*inputs), mlp(*inputs))
