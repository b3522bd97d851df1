from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torchrl.data import Composite, LazyTensorStorage, TensorDictReplayBuffer, Unbounded
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import check_env_specs

from tests._transform_base import TransformTests, make_env
from torchrl_morl.transforms import LidarMinPool


class TestLidarMinPool(TransformTests):
    def make_transform(self):
        return LidarMinPool(4)

    def test_transform_no_env(self):
        scan = torch.rand(2, 3, 720)
        data = LidarMinPool()(TensorDict(scan=scan, batch_size=[2, 3]))
        expected = torch.stack([part.min(-1).values for part in scan.split(24, -1)], -1)
        assert torch.equal(data["lidar"], expected)
        assert torch.equal(data["scan"], scan)

    def test_transform_compose(self):
        pool = Compose(LidarMinPool(6), LidarMinPool(2, ["lidar"], ["coarse"]))
        scan = torch.rand(5, 12)
        assert torch.equal(pool(TensorDict(scan=scan))["coarse"], LidarMinPool(2)(scan=scan))

    @pytest.mark.parametrize("prefix", [None, "agent"])
    @pytest.mark.parametrize("batch_size", [(), (3,), (2, 2)])
    def test_transform_env(self, prefix, batch_size):
        base = make_env(prefix=prefix, batch_size=batch_size)
        scan, lidar = base.key("scan"), base.key("lidar")
        env = TransformedEnv(base, LidarMinPool(4, [scan], [lidar]))
        check_env_specs(env)
        reset = env.reset()
        assert torch.equal(reset[lidar], reset[scan].unflatten(-1, (4, 3)).amin(-1))
        step = env.rand_step(reset)["next"]
        assert torch.equal(step[lidar], step[scan].unflatten(-1, (4, 3)).amin(-1))

    def test_spec_bounds(self):
        base = make_env()
        bounds = base.observation_spec["scan"].space
        bounds.low = torch.arange(12.0) / 100
        bounds.high = 4 - torch.arange(12.0) / 100
        spec = TransformedEnv(base, LidarMinPool(4)).observation_spec["lidar"]
        assert torch.equal(spec.space.low, torch.tensor([0.0, 0.03, 0.06, 0.09]))
        assert torch.equal(spec.space.high, 4 - torch.tensor([0.02, 0.05, 0.08, 0.11]))
        unbounded = LidarMinPool(4).transform_observation_spec(Composite(scan=Unbounded(12)))
        assert unbounded["lidar"] == Unbounded(4)

    def test_transform_model(self):
        pool = LidarMinPool(4)
        data = TensorDict(scan=torch.rand(5, 12), batch_size=[5])
        assert TensorDictSequential(pool)(data)["lidar"].shape == (5, 4)
        compiled = torch.compile(pool, fullgraph=True, backend="eager")
        assert torch.equal(compiled(data.select("scan"))["lidar"], data["lidar"])

    def test_transform_rb(self):
        keys = ["scan", ("next", "scan")], ["lidar", ("next", "lidar")]
        buffer = TensorDictReplayBuffer(
            storage=LazyTensorStorage(10), batch_size=8, transform=LidarMinPool(4, *keys)
        )
        scan = torch.rand(10, 12)
        buffer.extend(TensorDict(scan=scan, next=TensorDict(scan=scan + 1), batch_size=[10]))
        batch = buffer.sample()
        assert torch.equal(batch["lidar"], batch["scan"].unflatten(-1, (4, 3)).amin(-1))
        assert torch.equal(batch["next", "lidar"], batch["lidar"] + 1)
        assert "lidar" not in buffer.storage.get(0)

    def test_transform_inverse(self):
        data = TensorDict(scan=torch.rand(12))
        assert (LidarMinPool(4).inv(data) == data).all()

    def test_invalid(self):
        with pytest.raises(ValueError, match="720 rays cannot be split in 7"):
            LidarMinPool(7)(TensorDict(scan=torch.ones(720)))
        with pytest.raises(ValueError, match="12 rays cannot be split in 5"):
            TransformedEnv(make_env(), LidarMinPool(5)).reset()
        with pytest.raises(ValueError, match="got 0"):
            LidarMinPool(0)
        with pytest.raises(ValueError, match="2 in_keys but 1 out_keys"):
            LidarMinPool(4, ["a", "b"])
        with pytest.raises(KeyError, match="scan"):
            LidarMinPool(4)(TensorDict(other=torch.ones(12)))
