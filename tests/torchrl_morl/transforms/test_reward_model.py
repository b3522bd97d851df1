from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.data import Bounded, Composite, LazyTensorStorage, TensorDictReplayBuffer, Unbounded
from torchrl.envs import ActionScaling, Compose, SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from tests._transform_base import TransformTests, make_env, parallel
from torchrl_morl.modules import RewardModel
from torchrl_morl.preferences import PreferenceSpace
from torchrl_morl.testing import VectorRewardMockEnv
from torchrl_morl.transforms import PreferenceSampler, RewardModelReward, ScalarizeReward

# One model for all: a batched environment compares the specs of its workers, tests their numbers.
MODEL = RewardModel(in_features=4, num_cells=(16,), last_layer_gain=5.0)


def entry(data, scale: float = 10.0, model=MODEL) -> torch.Tensor:
    score = model(data.select(*model.in_keys))[model.out_keys[0]]
    return (scale * (score - 1)).squeeze(-1).detach()


def transitions(*batch: int) -> TensorDict:
    return TensorDict(
        observation=torch.randn(*batch, 2),
        action=torch.rand(*batch, 2),
        next=TensorDict(reward=torch.rand(*batch, 3), observation=torch.randn(*batch, 2)),
        batch_size=batch,
    )


class ScaledActionEnv(VectorRewardMockEnv):
    """Wants actions in [0, 4] and remembers the last one."""

    def __init__(self, **kwargs) -> None:
        super().__init__(3, **kwargs)
        self.action_spec = Bounded(0.0, 4.0, shape=self._shape(2))

    def _step(self, tensordict):
        self.received = tensordict["action"].clone()
        return super()._step(tensordict)


def action_is_score() -> TensorDictModule:
    """R is the first entry of the action: tells in which units the model gets it."""
    return TensorDictModule(lambda a: a[..., :1].clone(), in_keys=["action"], out_keys=["score"])


class TestRewardModelReward(TransformTests):
    def make_transform(self):
        return RewardModelReward(MODEL)

    def test_transform_no_env(self):
        data = transitions(4, 2)
        before = data["next", "reward"].clone()
        after = self.make_transform()(data)["next", "reward"]
        assert after.shape == (4, 2, 4)
        assert torch.equal(after[..., [0, 2, 3]], before)
        assert torch.allclose(after[..., 1], entry(data))
        assert "reward" not in data
        assert "demo_score" not in data.keys(True, True)
        flat = transitions(4)
        flat["reward"] = flat.pop("next")["reward"]
        after = self.make_transform()(flat)["reward"]
        assert torch.allclose(after[..., 1], entry(flat))

    @pytest.mark.parametrize("position", [0, 1, 2, 3])
    def test_position_and_scale(self, position):
        data = transitions(5)
        before = data["next", "reward"]
        after = RewardModelReward(MODEL, position=position, scale=2.0)(data)["next", "reward"]
        assert torch.allclose(after[..., position], entry(data, 2.0))
        rest = [i for i in range(4) if i != position]
        assert torch.equal(after[..., rest], before)
        assert ((after[..., position] >= -2) & (after[..., position] <= 0)).all()

    def test_transform_compose(self):
        preference_space = PreferenceSpace(
            ("core", "demo", "distance", "efficiency"), static={"core": 1.0}
        )
        both = Compose(self.make_transform(), ScalarizeReward(preference_space))
        data = transitions(5)
        data["preference"] = preference_space.sample(5)
        data = both(data)
        expected = (preference_space.weights(data["preference"]) * data["next", "reward"]).sum(
            -1, True
        )
        assert torch.allclose(data["next", "scalar_reward"], expected)
        assert (data["next", "reward"][..., 1] < 0).all()

    @pytest.mark.parametrize("prefix", [None, "agent"])
    @pytest.mark.parametrize("batch_size", [(), (3,), (2, 2)])
    def test_transform_env(self, prefix, batch_size):
        base = make_env(prefix=prefix, batch_size=batch_size)
        reward = base.key("reward")
        model = RewardModel(
            in_features=4,
            in_keys=[base.key("observation"), base.key("action")],
            num_cells=(8,),
            out_key=base.key("style"),
            last_layer_gain=5.0,
        )
        env = TransformedEnv(
            base, RewardModelReward(model, reward_key=reward, score_key=base.key("style"))
        )
        check_env_specs(env)
        assert env.full_reward_spec[reward].shape == (*batch_size, 4)
        assert set(env.full_observation_spec.keys(True)) == set(
            base.full_observation_spec.keys(True)
        )
        data = env.rollout(8, break_when_any_done=False)
        assert torch.allclose(data["next", reward][..., 1], entry(data, model=model), atol=1e-5)
        assert base.key("style") not in data.keys(True, True)
        assert not any("_reward_model" in str(key) for key in data.keys(True, True))

    @pytest.mark.parametrize("vectorize", [SerialEnv, lambda n, make: parallel(make, n)])
    @pytest.mark.parametrize("inside", [True, False])
    def test_values_through_workers(self, vectorize, inside):
        def make():
            return TransformedEnv(make_env(), self.make_transform()) if inside else make_env()

        env = vectorize(2, make)
        if not inside:
            env = TransformedEnv(env, self.make_transform())
        try:
            # Across resets; the observation of the step must reach the worker.
            data = env.rollout(12, break_when_any_done=False)
            assert torch.allclose(data["next", "reward"][..., 1], entry(data), atol=1e-5)
            carried = env.rand_action(env.reset())
            carried["observation"] = torch.full((2, 2), 0.5)
            data = env.step(carried)
            assert torch.allclose(data["next", "reward"][..., 1], entry(data), atol=1e-5)
        finally:
            env.close()

    def test_sees_the_action_of_the_policy_behind_action_scaling(self):
        base = ScaledActionEnv(batch_size=(4,))
        transform = RewardModelReward(action_is_score(), score_key="score", position=3)
        env = TransformedEnv(base, Compose(ActionScaling(), transform))
        data = env.step(env.rand_action(env.reset()))
        action = data["action"]
        assert torch.allclose(base.received, 2 * (action + 1))
        assert torch.allclose(data["next", "reward"][..., 3], 10 * (action[..., 0] - 1), atol=1e-5)
        # The same model on what a replay buffer stores of this step.
        stored = data.clone()
        stored["next", "reward"] = stored["next", "reward"][..., :3]
        assert torch.allclose(transform.clone()(stored)["next", "reward"], data["next", "reward"])

    def test_sees_the_action_of_the_simulator_in_front_of_action_scaling(self):
        base = ScaledActionEnv(batch_size=(4,))
        transform = RewardModelReward(action_is_score(), score_key="score", position=3)
        env = TransformedEnv(base, Compose(transform, ActionScaling()))
        data = env.step(env.rand_action(env.reset()))
        reward = data["next", "reward"][..., 3]
        assert torch.allclose(reward, 10 * (base.received[..., 0] - 1), atol=1e-5)

    def test_two_models(self):
        other = RewardModel(in_features=2, in_keys=["action"], num_cells=(8,), out_key="calm")
        chain = Compose(
            self.make_transform(), RewardModelReward(other, score_key="calm", position=4)
        )
        env = TransformedEnv(make_env(), chain)
        check_env_specs(env)
        data = env.rollout(4)
        assert torch.allclose(data["next", "reward"][..., 1], entry(data), atol=1e-5)
        assert torch.allclose(data["next", "reward"][..., 4], entry(data, model=other), atol=1e-5)

    def test_a_preference_may_be_an_input(self):
        # Written by another transform, and already a state.
        preference_space = PreferenceSpace(("a", "b"))
        model = RewardModel(in_features=4, in_keys=["observation", "preference"], num_cells=(8,))
        env = TransformedEnv(
            make_env(), Compose(PreferenceSampler(preference_space), RewardModelReward(model))
        )
        check_env_specs(env)
        data = env.rollout(4)
        assert torch.allclose(data["next", "reward"][..., 1], entry(data, model=model))

    @pytest.mark.parametrize("bounded", [True, False])
    def test_reward_spec(self, bounded):
        low, high = torch.tensor([-1.0, -2.0, -3.0]), torch.tensor([1.0, 2.0, 3.0])
        spec = Bounded(low, high) if bounded else Unbounded(3)
        transform = RewardModelReward(MODEL, position=2, scale=5.0)
        spec = transform.transform_reward_spec(Composite(reward=spec))["reward"]
        assert spec.shape == (4,)
        assert isinstance(spec, Bounded) == bounded
        if bounded:
            assert spec.space.low.tolist() == [-1, -2, -5, -3]
            assert spec.space.high.tolist() == [1, 2, 0, 3]

    def test_transform_model(self):
        model = self.make_transform()
        data = transitions(5)
        compiled = torch.compile(model, fullgraph=True, backend="eager")(data.clone())
        eager = TensorDictSequential(model)(data)
        assert torch.equal(compiled["next", "reward"], eager["next", "reward"])

    def test_transform_rb(self):
        buffer = TensorDictReplayBuffer(
            storage=LazyTensorStorage(20), batch_size=16, transform=self.make_transform()
        )
        data = transitions(20)
        buffer.extend(data)
        batch = buffer.sample()
        assert batch["next", "reward"].shape == (16, 4)
        assert torch.allclose(batch["next", "reward"][..., 1], entry(batch))
        stored = buffer.storage.get(slice(0, 20))
        assert torch.equal(stored["next", "reward"], data["next", "reward"])
        assert set(data.keys(True, True)) == {k for k in stored.keys(True, True) if k != "index"}

    def test_a_model_of_two_outputs(self):
        model = TensorDictModule(nn.Linear(2, 2), in_keys=["observation"], out_keys=["demo_score"])
        with pytest.raises(ValueError, match=r"'demo_score' of shape \[5, 2\]: it must end in 1"):
            RewardModelReward(model)(transitions(5))

    @pytest.mark.parametrize("scale", [float("nan"), float("inf"), 0.0])
    def test_scales_that_are_none(self, scale):
        with pytest.raises(ValueError, match="scale must be positive and finite"):
            RewardModelReward(MODEL, scale=scale)

    def test_env_and_replay_buffer_agree(self):
        env = TransformedEnv(make_env(batch_size=(3,)), self.make_transform())
        data = env.rollout(5)
        recorded = data.clone()
        recorded["next", "reward"] = recorded["next", "reward"][..., [0, 2, 3]]
        again = self.make_transform()(recorded)
        assert torch.allclose(again["next", "reward"], data["next", "reward"], atol=1e-5)

    def test_transform_inverse(self):
        data = transitions(3)
        inverse = self.make_transform().inv(data)
        assert set(inverse.keys(True, True)) == set(data.keys(True, True))
        assert (inverse == data).all()

    def test_is_frozen(self):
        network = nn.Sequential(nn.Linear(2, 1), nn.Dropout(), nn.Sigmoid())
        model = TensorDictModule(network, in_keys=["observation"], out_keys=["demo_score"])
        transform = RewardModelReward(model)
        assert not any(parameter.requires_grad for parameter in transform.parameters())
        assert all(parameter.requires_grad for parameter in model.parameters())
        transform.train()
        assert not any(module.training for module in transform.reward_model.modules())
        assert network.training
        data = transitions(4)
        data["observation"].requires_grad_()
        before = transform(data.clone())["next", "reward"]
        assert not before.requires_grad
        # Training goes on elsewhere.
        network[0].weight.data.add_(1.0)
        assert torch.equal(transform(data.clone())["next", "reward"], before)

    def test_state_dict_and_clone(self):
        transform = RewardModelReward(RewardModel(in_features=4, num_cells=(8,)))
        assert set(transform.state_dict()) == {
            f"reward_model.module.members.0.{layer}.{name}"
            for layer in (0, 2)
            for name in ("weight", "bias")
        }
        other = RewardModelReward(RewardModel(in_features=4, num_cells=(8,)))
        other.load_state_dict(transform.state_dict())
        data = transitions(4)
        expected = transform(data.clone())["next", "reward"]
        assert torch.equal(other(data.clone())["next", "reward"], expected)
        env = TransformedEnv(make_env(), transform)
        assert torch.equal(transform.clone()(data.clone())["next", "reward"], expected)
        train, test = env, TransformedEnv(make_env(), transform.clone())
        assert train.rollout(2)["next", "reward"].shape == test.rollout(2)["next", "reward"].shape

    def test_dtype_and_device_of_the_reward(self):
        data = transitions(4)
        data["next", "reward"] = data["next", "reward"].double()
        assert self.make_transform()(data)["next", "reward"].dtype == torch.double
        moved = self.make_transform().to("meta")
        assert {parameter.device.type for parameter in moved.parameters()} == {"meta"}

    @pytest.mark.gpu
    def test_gpu(self):
        env = TransformedEnv(make_env(batch_size=(3,), device="cuda"), self.make_transform())
        data = env.rollout(5)
        assert data["next", "reward"].device.type == "cuda"
        assert torch.allclose(data["next", "reward"][..., 1].cpu(), entry(data.cpu()), atol=1e-4)

    def test_invalid(self):
        with pytest.raises(ValueError, match=r"writes \['demo_score'\], not 'style'"):
            RewardModelReward(MODEL, score_key="style")
        with pytest.raises(ValueError, match="scale must be positive"):
            RewardModelReward(MODEL, scale=0.0)
        with pytest.raises(ValueError, match="position must be at least 0, got -"):
            RewardModelReward(MODEL, position=-1)
        transform = RewardModelReward(MODEL, position=4)
        with pytest.raises(ValueError, match="position 4 is beyond the end of 'reward'"):
            transform(transitions(2))
        with pytest.raises(ValueError, match="has 3 entries"):
            TransformedEnv(make_env(), transform).rollout(2)
        env = TransformedEnv(make_env(), self.make_transform())
        with pytest.raises(KeyError, match="observation"):
            env.step(env.reset().select("done").update(env.rand_action()))
