from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import check_env_specs

from tests._transform_base import TransformTests, make_env
from torchrl_morl.transforms import LidarMinPool, VelocityInFrame


def transition() -> TensorDict:
    """Half a metre a second along x, y and not at all; seen ahead, from its right and along y."""
    before = torch.tensor([[1.0, 1.0, 0.0], [1.0, 1.0, 3.0], [2.0, -1.0, 1.0]])
    after = torch.tensor([[1.1, 1.0, 0.0], [1.0, 1.1, 3.0], [2.0, -1.0, 2.0]])
    pose = torch.tensor([[0.0, 5.0, 0.0], [9.0, 0.0, 0.0], [0.0, 0.0, math.pi / 2]])
    later = TensorDict(human_pose=after, pose=pose, batch_size=3)
    return TensorDict(human_pose=before, pose=-pose, next=later, batch_size=3)


EXPECTED = torch.tensor([[0.5, 0.0], [0.0, 0.5], [0.0, 0.0]])


class TestVelocityInFrame(TransformTests):
    def make_transform(self):
        # Of what the mock environment has: x and y of one key, the heading of another.
        return VelocityInFrame("observation", "scan", "velocity", period=0.5)

    def test_transform_no_env(self):
        data = VelocityInFrame(period=0.2)(transition())
        torch.testing.assert_close(data["next", "human_velocity"], EXPECTED)

    @pytest.mark.parametrize("turned", [math.pi / 2, math.pi, -math.pi / 2, 1.0])
    def test_a_robot_that_has_turned_sees_it_from_another_side(self, turned):
        data = transition()
        data["next", "pose"][:, 2] += turned
        VelocityInFrame(period=0.2)(data)
        ahead, left = EXPECTED.unbind(-1)
        cos, sin = math.cos(turned), math.sin(turned)
        expected = torch.stack((cos * ahead + sin * left, cos * left - sin * ahead), -1)
        torch.testing.assert_close(data["next", "human_velocity"], expected)

    def test_transform_compose(self):
        env = TransformedEnv(make_env(), Compose(LidarMinPool(4), self.make_transform()))
        check_env_specs(env)
        assert env.observation_spec["velocity"].shape == (2,)

    @pytest.mark.parametrize("prefix", [None, "agent"])
    @pytest.mark.parametrize("batch_size", [(), (3,), (2, 2)])
    def test_transform_env(self, prefix, batch_size):
        """Zero after a reset, also after one on the way, and never across two episodes."""
        base = make_env(prefix=prefix, batch_size=batch_size)
        position, frame, out = (base.key(name) for name in ("observation", "scan", "velocity"))
        env = TransformedEnv(base, VelocityInFrame(position, frame, out, period=0.5))
        check_env_specs(env)
        assert (env.reset()[out] == 0).all()
        data = env.rollout(15, break_when_any_done=False)
        moved = 2 * (data["next", position] - data[position])
        heading = data["next", frame][..., 2]
        cos, sin = heading.cos(), heading.sin()
        ahead, left = (
            cos * moved[..., 0] + sin * moved[..., 1],
            cos * moved[..., 1] - sin * moved[..., 0],
        )
        torch.testing.assert_close(data["next", out], torch.stack((ahead, left), -1))
        ended = data["next", "done"][..., :-1, 0]
        assert ended.any()
        following = data[..., 1:][out]
        assert (following[ended] == 0).all()
        assert torch.equal(following[~ended], data[..., :-1]["next", out][~ended])

    def test_transform_model(self):
        data = TensorDictSequential(VelocityInFrame(period=0.2))(transition())
        torch.testing.assert_close(data["next", "human_velocity"], EXPECTED)

    def test_transform_rb(self):
        transform = VelocityInFrame(period=0.2)
        buffer = TensorDictReplayBuffer(
            storage=LazyTensorStorage(3), batch_size=16, transform=transform
        )
        buffer.extend(transition())
        batch = buffer.sample()
        torch.testing.assert_close(batch["next", "human_velocity"], EXPECTED[batch["index"]])

    def test_transform_inverse(self):
        data = transition()
        assert (VelocityInFrame(period=0.2).inv(data.clone()) == data).all()

    def test_positions_of_higher_precision(self):
        data = VelocityInFrame(period=0.2)(transition().double())
        assert data["next", "human_velocity"].dtype == torch.float32
        data = VelocityInFrame(period=0.2, dtype=torch.float64)(transition().double())
        torch.testing.assert_close(data["next", "human_velocity"], EXPECTED.double())

    @pytest.mark.parametrize("period", [0.0, -0.2, math.nan, math.inf])
    def test_invalid(self, period):
        with pytest.raises(
            ValueError, match=f"period must be finite and > 0 seconds, got {period}"
        ):
            VelocityInFrame(period=period)
