from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torchrl.data import Composite, LazyTensorStorage, TensorDictReplayBuffer, Unbounded
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import check_env_specs

from tests._transform_base import TransformTests, make_env
from torchrl_morl.transforms import LidarMinPool, PolarFeatures

GOAL = torch.tensor([[2.0, 0.0], [4.0, math.pi / 2], [0.0, math.pi], [8.0, -math.pi]])
EXPECTED = torch.tensor([[0.5, 0.0, 1.0], [1.0, 1.0, 0.0], [0.0, 0.0, -1.0], [2.0, 0.0, -1.0]])


class TestPolarFeatures(TransformTests):
    def make_transform(self):
        return PolarFeatures(scale=[10.0, 4.0])

    def test_transform_no_env(self):
        data = PolarFeatures(["goal"], ["out"], scale=4.0)(TensorDict(goal=GOAL, batch_size=[4]))
        assert torch.allclose(data["out"], EXPECTED, atol=1e-6)
        assert torch.equal(data["goal"], GOAL)

    def test_one_scale_per_key(self):
        data = TensorDict(goal=GOAL, human=GOAL, batch_size=[4])
        PolarFeatures(scale=[1.0, 2.0])(data)
        assert torch.equal(data["goal_features"][:, 0], GOAL[:, 0])
        assert torch.equal(data["human_features"][:, 0], GOAL[:, 0] / 2)
        goal, human = PolarFeatures(scale=2.0)(goal=GOAL, human=GOAL)
        assert torch.equal(goal, human)

    def test_transform_compose(self):
        env = TransformedEnv(make_env(), Compose(LidarMinPool(4), self.make_transform()))
        check_env_specs(env)
        assert {"lidar", "goal_features", "human_features"} <= set(env.reset().keys())

    @pytest.mark.parametrize("prefix", [None, "agent"])
    @pytest.mark.parametrize("batch_size", [(), (3,), (2, 2)])
    def test_transform_env(self, prefix, batch_size):
        base = make_env(prefix=prefix, batch_size=batch_size)
        goal, out = base.key("goal"), base.key("goal_features")
        env = TransformedEnv(base, PolarFeatures([goal], [out], scale=10.0))
        check_env_specs(env)
        reset = env.reset()
        for data in (reset, env.rand_step(reset)["next"]):
            distance, bearing = data[goal].unbind(-1)
            expected = torch.stack([distance / 10, bearing.sin(), bearing.cos()], -1)
            assert torch.equal(data[out], expected)

    def test_spec_bounds(self):
        spec = TransformedEnv(make_env(), self.make_transform()).observation_spec
        assert spec["goal_features"].space.low.tolist() == [0.0, -1.0, -1.0]
        assert spec["goal_features"].space.high.tolist() == [1.0, 1.0, 1.0]
        assert spec["human_features"].space.high.tolist() == [2.5, 1.0, 1.0]
        unbounded = PolarFeatures(["goal"], ["out"]).transform_observation_spec(
            Composite(goal=Unbounded(2))
        )
        assert unbounded["out"] == Unbounded(3)

    def test_transform_model(self):
        features = PolarFeatures(["goal"], ["out"], scale=4.0)
        data = TensorDict(goal=GOAL, batch_size=[4])
        assert torch.allclose(TensorDictSequential(features)(data)["out"], EXPECTED, atol=1e-6)
        compiled = torch.compile(features, fullgraph=True, backend="eager")
        assert torch.equal(compiled(data.select("goal"))["out"], data["out"])

    def test_transform_rb(self):
        features = PolarFeatures(["goal", ("next", "goal")], ["out", ("next", "out")], 4.0)
        buffer = TensorDictReplayBuffer(
            storage=LazyTensorStorage(4), batch_size=16, transform=features
        )
        buffer.extend(TensorDict(goal=GOAL, next=TensorDict(goal=2 * GOAL), batch_size=[4]))
        batch = buffer.sample()
        assert torch.equal(batch["out"][:, 0], batch["goal"][:, 0] / 4)
        assert torch.equal(batch["next", "out"][:, 0], batch["goal"][:, 0] / 2)

    def test_transform_inverse(self):
        data = TensorDict(goal=GOAL, human=GOAL)
        assert (self.make_transform().inv(data) == data).all()

    def test_invalid(self):
        with pytest.raises(ValueError, match="3 scales for 2 in_keys"):
            PolarFeatures(scale=[1.0, 2.0, 3.0])
        for scale in (0.0, -1.0, math.nan, math.inf):
            with pytest.raises(ValueError, match=f"'human' must be finite and > 0, got {scale}"):
                PolarFeatures(scale=[1.0, scale])
        with pytest.raises(ValueError, match="1 in_keys but 2 out_keys"):
            PolarFeatures(["goal"])
        with pytest.raises(KeyError, match="human"):
            PolarFeatures()(TensorDict(goal=GOAL))
