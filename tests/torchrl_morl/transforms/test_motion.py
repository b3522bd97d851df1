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
from torchrl_morl.transforms import LidarMinPool, MotionInUnits, OwnMotion


def transition() -> TensorDict:
    """Half a metre a second ahead along x, sideways along y, and a turn over the seam of the circle."""
    before = torch.tensor([[1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 3.1]])
    after = torch.tensor([[1.1, 1.0, 0.0], [1.0, 1.1, 0.0], [0.0, 0.0, 0.1 + 3.1 - 2 * math.pi]])
    motion = torch.tensor([9.0, 9.0, 0.3, 0.1, 0.2, 0.0]).expand(3, 6)
    return TensorDict(
        pose=before,
        motion=motion,
        action=torch.tensor([0.5, -1.0]).expand(3, 2),
        next=TensorDict(pose=after, batch_size=3),
        batch_size=3,
    )


EXPECTED = torch.tensor(
    [
        [0.5, 0.0, 0.5, -1.0, 0.3, 0.1],
        [0.0, 0.0, 0.5, -1.0, 0.3, 0.1],
        [0.0, 0.5, 0.5, -1.0, 0.3, 0.1],
    ]
)


def own_motion() -> OwnMotion:
    return OwnMotion(period=0.2, num_commands=2)


class TestOwnMotion(TransformTests):
    def make_transform(self):
        return OwnMotion("scan", "action", "own", period=0.5, num_commands=3)

    def test_transform_no_env(self):
        torch.testing.assert_close(own_motion()(transition())["next", "motion"], EXPECTED)

    def test_transform_compose(self):
        env = TransformedEnv(make_env(), Compose(LidarMinPool(4), self.make_transform()))
        check_env_specs(env)
        assert env.observation_spec["own"].shape == (8,)

    @pytest.mark.parametrize("prefix", [None, "agent"])
    @pytest.mark.parametrize("batch_size", [(), (3,), (2, 2)])
    def test_transform_env(self, prefix, batch_size):
        """The last commands, the latest first; zero after a reset, and never of another episode."""
        base = make_env(prefix=prefix, batch_size=batch_size)
        pose, action, out = (base.key(name) for name in ("scan", "action", "own"))
        env = TransformedEnv(base, OwnMotion(pose, action, out, period=0.5, num_commands=3))
        check_env_specs(env)
        assert (env.reset()[out] == 0).all()
        data = env.rollout(15, break_when_any_done=False)
        later, now = data["next", out], data[out]
        torch.testing.assert_close(later[..., 2:4], data[action])
        torch.testing.assert_close(later[..., 4:], now[..., 2:6])
        ended = data["next", "done"][..., :-1, 0]
        assert ended.any()
        following = data[..., 1:][out]
        assert (following[ended] == 0).all()
        assert torch.equal(following[~ended], later[..., :-1, :][~ended])

    def test_transform_model(self):
        data = TensorDictSequential(own_motion())(transition())
        torch.testing.assert_close(data["next", "motion"], EXPECTED)

    def test_transform_rb(self):
        buffer = TensorDictReplayBuffer(
            storage=LazyTensorStorage(3), batch_size=16, transform=own_motion()
        )
        buffer.extend(transition())
        batch = buffer.sample()
        torch.testing.assert_close(batch["next", "motion"], EXPECTED[batch["index"]])

    def test_transform_inverse(self):
        data = transition()
        assert (own_motion().inv(data.clone()) == data).all()

    def test_commands_that_are_shares_of_limits(self):
        """At 0.5 m/s and 3 rad/s a share of 0.8 is 0.4 m/s, and one of -0.5 is -1.5 rad/s."""
        data = transition()
        data["robot"] = torch.tensor([0.2, 0.5, 3.0, 6.28, 4.0, 0.0]).expand(3, 6)
        data["action"] = torch.tensor([0.8, -0.5]).expand(3, 2)
        motion = OwnMotion(robot_key="robot", period=0.2, num_commands=2)(data)["next", "motion"]
        torch.testing.assert_close(motion[:, 2:4], torch.tensor([0.4, -1.5]).expand(3, 2))
        # What was measured, and what was told before that, is in m/s and rad/s already.
        torch.testing.assert_close(motion[:, [0, 1, 4, 5]], EXPECTED[:, [0, 1, 4, 5]])

    def test_robots_that_are_none(self):
        data = transition()
        transform = OwnMotion(robot_key="robot", period=0.2, num_commands=2)
        with pytest.raises(KeyError, match="robot"):
            transform(data)
        data["robot"] = torch.zeros(3, 2)
        with pytest.raises(ValueError, match=r"robot must have shape \[..., 6\], got \[3, 2\]"):
            transform(data)

    @pytest.mark.parametrize("turned", [math.pi / 2, -2.0])
    def test_speed_is_along_the_heading(self, turned):
        data = transition()
        for pose in (data["pose"], data["next", "pose"]):
            x, y, heading = pose.clone().unbind(-1)
            cos, sin = math.cos(turned), math.sin(turned)
            pose.copy_(torch.stack((cos * x - sin * y, sin * x + cos * y, heading + turned), -1))
        torch.testing.assert_close(own_motion()(data)["next", "motion"], EXPECTED)

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            ({"period": 0.0}, "period must be finite and > 0 seconds, got 0.0"),
            ({"period": math.nan}, "period must be finite and > 0 seconds, got nan"),
            ({"period": 0.2, "num_commands": 0}, "num_commands must be at least 1, got 0"),
            ({"period": 0.2, "num_commands": 1.5}, "num_commands must be a whole number"),
        ],
    )
    def test_invalid(self, arguments, message):
        with pytest.raises(ValueError, match=message):
            OwnMotion(**arguments)


def test_shares_of_the_largest():
    robot = torch.tensor([[0.2, 0.5, 2.0, 6.0, 4.0, 0.0], [0.2, 1.0, 4.0, 6.0, 4.0, 0.0]])
    motion = torch.tensor([0.5, -1.0, 0.25, 2.0]).expand(2, 4)
    data = MotionInUnits()(TensorDict(motion=motion, robot=robot, batch_size=2))
    expected = torch.tensor([[1.0, -0.5, 0.5, 1.0], [0.5, -0.25, 0.25, 0.5]])
    torch.testing.assert_close(data["own_motion"], expected)
    assert torch.equal(data["motion"], motion)
