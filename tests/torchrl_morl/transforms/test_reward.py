from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from tests._transform_base import SPACE, TransformTests, make_env
from torchrl_morl.preferences import PreferenceSpace
from torchrl_morl.transforms import PreferenceRelabel, PreferenceSampler, ScalarizeReward


def scalar(data) -> torch.Tensor:
    return (SPACE.weights(data["preference"]) * data["next", "reward"]).sum(-1, keepdim=True)


def transitions(*batch: int) -> TensorDict:
    following = TensorDict(reward=torch.rand(*batch, 3), preference=SPACE.sample(batch))
    return TensorDict(preference=SPACE.sample(batch), next=following, batch_size=batch)


class TestScalarizeReward(TransformTests):
    def make_transform(self):
        return Compose(PreferenceSampler(SPACE), ScalarizeReward(SPACE))

    def test_transform_no_env(self):
        data = ScalarizeReward(SPACE)(transitions(4, 2))
        assert torch.allclose(data["next", "scalar_reward"], scalar(data))
        assert "scalar_reward" not in data
        flat = TensorDict(preference=torch.tensor([0.5, 0.5]), reward=torch.tensor([3.0, -2, -6]))
        assert ScalarizeReward(SPACE)(flat)["scalar_reward"].tolist() == [-1.0]

    def test_next_reward_goes_before_that_of_the_last_step(self):
        data = transitions(4)
        data["reward"] = torch.full((4, 3), 100.0)
        ScalarizeReward(SPACE)(data)
        assert torch.allclose(data["next", "scalar_reward"], scalar(data))
        assert "scalar_reward" not in data

    def test_transform_compose(self):
        both = Compose(PreferenceRelabel(SPACE, 1.0), ScalarizeReward(SPACE))
        data = transitions(50)
        before = scalar(data)
        data = both(data)
        assert torch.allclose(data["next", "scalar_reward"], scalar(data))
        assert (data["next", "scalar_reward"] != before).all()

    @pytest.mark.parametrize("prefix", [None, "agent"])
    @pytest.mark.parametrize("batch_size", [(), (3,), (2, 2)])
    def test_transform_env(self, prefix, batch_size):
        base = make_env(prefix=prefix, batch_size=batch_size)
        key, reward, out = (base.key(k) for k in ("preference", "reward", "scalar_reward"))
        env = TransformedEnv(
            base,
            Compose(
                PreferenceSampler(SPACE, preference_key=key),
                ScalarizeReward(SPACE, [reward], [out], preference_key=key),
            ),
        )
        check_env_specs(env)
        assert env.full_reward_spec[out].shape == (*batch_size, 1)
        assert env.full_reward_spec[reward].shape == (*batch_size, 3)
        data = env.rollout(8, break_when_any_done=False)
        expected = (SPACE.weights(data[key]) * data["next", reward]).sum(-1, keepdim=True)
        assert torch.allclose(data["next", out], expected)

    def test_preference_at_t_counts(self):
        env = TransformedEnv(make_env(), self.make_transform())
        carried = env.reset()
        for wish in torch.eye(2):
            carried["preference"] = wish
            stored, carried = env.step_and_maybe_reset(env.rand_action(carried))
            reward = stored["next", "reward"]
            expected = reward[0] + (wish * reward[1:]).sum()
            assert torch.allclose(stored["next", "scalar_reward"], expected)

    def test_preference_from_the_workers(self):
        def make():
            return TransformedEnv(make_env(), PreferenceSampler(SPACE))

        env = TransformedEnv(SerialEnv(2, make), ScalarizeReward(SPACE))
        check_env_specs(env)
        data = env.rollout(8, break_when_any_done=False)
        assert torch.allclose(data["next", "scalar_reward"], scalar(data))

    def test_transform_model(self):
        model = ScalarizeReward(SPACE)
        data = transitions(5)
        compiled = torch.compile(model, fullgraph=True, backend="eager")(data.clone())
        eager = TensorDictSequential(model)(data)
        assert torch.equal(compiled["next", "scalar_reward"], eager["next", "scalar_reward"])

    @pytest.mark.parametrize("explicit", [False, True])
    def test_transform_rb(self, explicit):
        keys = ([("next", "reward")], [("next", "scalar_reward")]) if explicit else ()
        buffer = TensorDictReplayBuffer(
            storage=LazyTensorStorage(20), batch_size=16, transform=ScalarizeReward(SPACE, *keys)
        )
        buffer.extend(transitions(20))
        batch = buffer.sample()
        assert torch.allclose(batch["next", "scalar_reward"], scalar(batch))
        assert "scalar_reward" not in batch
        assert ("next", "scalar_reward") not in buffer.storage.get(0).keys(True)

    def test_transform_inverse(self):
        data = transitions(3)
        assert (ScalarizeReward(SPACE).inv(data) == data).all()

    def test_static_weights(self):
        preference_space = PreferenceSpace(("a", "b"), static={"a": -2.0})
        data = TensorDict(preference=torch.ones(1), reward=torch.tensor([3.0, 5.0]))
        assert ScalarizeReward(preference_space)(data)["scalar_reward"].tolist() == [-1.0]

    def test_invalid(self):
        preference_space = PreferenceSpace(("a", "b"))
        env = TransformedEnv(
            make_env(),
            Compose(PreferenceSampler(preference_space), ScalarizeReward(preference_space)),
        )
        with pytest.raises(ValueError, match=r"'reward' has 3 entries, but there are 2 objectives"):
            env.rollout(2)
        data = TensorDict(preference=torch.ones(2) / 2, reward=torch.ones(1))
        with pytest.raises(ValueError, match="1 entries"):
            ScalarizeReward(preference_space)(data)
        with pytest.raises(KeyError, match="preference"):
            TransformedEnv(make_env(), ScalarizeReward(SPACE)).rollout(2)
        with pytest.raises(ValueError, match="2 in_keys but 1 out_keys"):
            ScalarizeReward(SPACE, ["a", "b"])
