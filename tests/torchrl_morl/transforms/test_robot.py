"""Which robot it is: ranges from its hull, speeds in units of its own, its numbers, and nobody."""

from __future__ import annotations

import copy
import math
import pickle

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer, Unbounded
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import check_env_specs

from tests._transform_base import TransformTests, make_env
from torchrl_morl.transforms import (
    HullRange,
    InUnitsOf,
    IsNobody,
    LidarMinPool,
    RobotScale,
    hull_ranges,
)

ROBOT = torch.tensor([0.2, 0.5, 3.0, 6.28, 4.0, 0.1])


def robots(*batch: int) -> torch.Tensor:
    return 0.1 + torch.rand(*batch, 6)


def reports_robots(prefix: str | None = None) -> LidarMinPool:
    """Six numbers of what the mock environment has, in place of those of a robot."""
    scan, robot = ("scan", "robot") if prefix is None else ((prefix, "scan"), (prefix, "robot"))
    return LidarMinPool(6, in_keys=[scan], out_keys=[robot])


def refused(transform, **entries) -> str:
    with pytest.raises(ValueError) as error:
        transform(TensorDict(entries))
    assert "\n" not in str(error.value)
    return str(error.value)


class TestHullRanges:
    @pytest.mark.parametrize("sectors", [1, 2, 7, 30])
    def test_a_lidar_at_the_centre_sees_the_hull_all_around(self, sectors):
        robot = ROBOT.clone()
        robot[5] = 0.0
        lidar = 0.3 + torch.rand(sectors)
        torch.testing.assert_close(hull_ranges(lidar, robot), lidar - 0.2)

    @pytest.mark.parametrize("offset", [-0.15, 0.1, 0.2])
    def test_to_the_sides_it_is_a_triangle_with_a_right_angle(self, offset):
        robot = ROBOT.clone()
        robot[5] = offset
        expected = [math.hypot(offset, one) - 0.2 for one in (0.5, 2.0)]
        found = hull_ranges(torch.tensor([0.5, 2.0]), robot)
        torch.testing.assert_close(found, torch.tensor(expected))

    def test_behind_it_the_offset_is_subtracted(self):
        """One sector all around has its middle behind the robot."""
        found = hull_ranges(torch.tensor([1.0]), ROBOT)
        torch.testing.assert_close(found, torch.tensor([1.0 - 0.1 - 0.2]))

    @pytest.mark.parametrize("index", range(8))
    def test_what_is_seen_is_where_the_beam_ends(self, index):
        """By points: the lidar's place, and from it the range along the middle of a sector."""
        lidar = 0.5 + torch.rand(8)
        angle = (index + 0.5) * math.pi / 4
        point = complex(0.1, 0.0) + complex(math.cos(angle), math.sin(angle)) * lidar[index].item()
        assert hull_ranges(lidar, ROBOT)[index].item() == pytest.approx(abs(point) - 0.2, abs=1e-6)

    def test_at_least_a_millimetre(self):
        assert (hull_ranges(torch.zeros(4), ROBOT) == 1e-3).all()


class TestHullRange(TransformTests):
    def make_transform(self):
        return Compose(reports_robots(), HullRange("scan"))

    def test_transform_no_env(self):
        lidar = 0.3 + torch.rand(5, 8)
        data = HullRange()(TensorDict(lidar=lidar, robot=ROBOT.expand(5, 6), batch_size=[5]))
        torch.testing.assert_close(data["hull_lidar"], hull_ranges(lidar, ROBOT))
        assert torch.equal(data["lidar"], lidar)
        torch.testing.assert_close(HullRange()(lidar=lidar, robot=ROBOT), data["hull_lidar"])

    def test_each_of_a_batch_has_its_own_hull(self):
        data = TensorDict(lidar=0.5 + torch.rand(2, 3, 8), robot=robots(2, 3), batch_size=[2, 3])
        found = HullRange()(data)["hull_lidar"]
        for place in ((0, 0), (0, 2), (1, 1)):
            torch.testing.assert_close(
                found[place], hull_ranges(data["lidar"][place], data["robot"][place])
            )

    def test_transform_compose(self):
        env = TransformedEnv(make_env(), Compose(*self.make_transform(), LidarMinPool(4)))
        check_env_specs(env)
        assert {"lidar", "hull_lidar", "robot"} <= set(env.reset().keys())

    @pytest.mark.parametrize("prefix", [None, "agent"])
    @pytest.mark.parametrize("batch_size", [(), (3,), (2, 2)])
    def test_transform_env(self, prefix, batch_size):
        base = make_env(prefix=prefix, batch_size=batch_size)
        scan, out, robot = (base.key(name) for name in ("scan", "hull_lidar", "robot"))
        env = TransformedEnv(base, Compose(reports_robots(prefix), HullRange(scan, out, robot)))
        check_env_specs(env)
        assert env.observation_spec[out].shape == (*batch_size, 12)
        data = env.rollout(15, break_when_any_done=False)
        for at in (data, data["next"]):
            assert torch.equal(at[out], hull_ranges(at[scan], at[robot]))

    def test_transform_model(self):
        data = TensorDict(lidar=1 + torch.rand(3, 4), robot=robots(3), batch_size=[3])
        expected = hull_ranges(data["lidar"], data["robot"])
        assert torch.equal(TensorDictSequential(HullRange())(data)["hull_lidar"], expected)
        compiled = torch.compile(HullRange(), fullgraph=True, backend="eager")
        assert torch.equal(compiled(data.select("lidar", "robot"))["hull_lidar"], expected)

    def test_transform_rb(self):
        transform = Compose(
            HullRange(), HullRange(("next", "lidar"), ("next", "hull_lidar"), ("next", "robot"))
        )
        buffer = TensorDictReplayBuffer(
            storage=LazyTensorStorage(4), batch_size=16, transform=transform
        )
        data = TensorDict(lidar=1 + torch.rand(4, 8), robot=robots(4), batch_size=[4])
        data["next"] = TensorDict(lidar=1 + torch.rand(4, 8), robot=robots(4), batch_size=[4])
        buffer.extend(data)
        batch = buffer.sample()
        for at in (batch, batch["next"]):
            assert torch.equal(at["hull_lidar"], hull_ranges(at["lidar"], at["robot"]))

    def test_transform_inverse(self):
        data = TensorDict(lidar=torch.rand(3), robot=ROBOT)
        assert (HullRange().inv(data.clone()) == data).all()

    def test_robots_of_higher_precision(self):
        """A simulator's numbers may be: entries keep the dtype that the specs say."""
        data = TensorDict(lidar=torch.ones(8), robot=ROBOT.double(), velocity=torch.ones(2))
        InUnitsOf("velocity")(HullRange()(data))
        assert data["hull_lidar"].dtype == data["velocity"].dtype == torch.float32
        torch.testing.assert_close(data["hull_lidar"], hull_ranges(torch.ones(8), ROBOT))

    def test_invalid(self):
        line = refused(HullRange(), lidar=torch.ones(8), robot=torch.ones(8))
        assert line == "robot must have shape [..., 6], got [8]."
        line = refused(HullRange(robot_key=("a", "b")), lidar=torch.ones(8), a={"b": ROBOT[:5]})
        assert line == "('a', 'b') must have shape [..., 6], got [5]."
        for given in ({"lidar": torch.ones(8)}, {"robot": ROBOT}):
            with pytest.raises(KeyError, match="robot" if "lidar" in given else "lidar"):
                HullRange()(TensorDict(given))


class TestInUnitsOf(TransformTests):
    def make_transform(self):
        return Compose(reports_robots(), InUnitsOf("goal"))

    def test_transform_no_env(self):
        data = TensorDict(
            velocity=torch.tensor([[1.0, -0.5], [0.0, 2.0]]),
            robot=torch.stack((ROBOT, 2 * ROBOT)),
            batch_size=[2],
        )
        found = InUnitsOf("velocity")(data)["velocity"]
        torch.testing.assert_close(found, torch.tensor([[2.0, -1.0], [0.0, 2.0]]))

    def test_transform_compose(self):
        env = TransformedEnv(make_env(), Compose(*self.make_transform(), LidarMinPool(4)))
        check_env_specs(env)
        assert isinstance(env.observation_spec["goal"], Unbounded)  # no bounds in m/s

    @pytest.mark.parametrize("prefix", [None, "agent"])
    @pytest.mark.parametrize("batch_size", [(), (3,), (2, 2)])
    def test_transform_env(self, prefix, batch_size):
        """Every step once, also after a reset on the way."""
        base = make_env(prefix=prefix, batch_size=batch_size, seed=0)
        velocity, robot = base.key("observation"), base.key("robot")
        env = TransformedEnv(base, Compose(reports_robots(prefix), InUnitsOf(velocity, robot)))
        check_env_specs(env)
        env.set_seed(0)
        data = env.rollout(15, break_when_any_done=False)
        plain = make_env(prefix=prefix, batch_size=batch_size)
        plain.set_seed(0)
        expected = plain.rollout(
            15, policy=replayed(data, plain.key("action")), break_when_any_done=False
        )
        for at, before in ((data, expected), (data["next"], expected["next"])):
            torch.testing.assert_close(at[velocity], before[velocity] / at[robot][..., 1:2])

    def test_transform_model(self):
        data = TensorDict(velocity=torch.rand(3, 2), robot=robots(3), batch_size=[3])
        expected = data["velocity"] / data["robot"][:, 1:2]
        transform = InUnitsOf("velocity")
        assert torch.equal(TensorDictSequential(transform)(data.clone())["velocity"], expected)
        compiled = torch.compile(transform, fullgraph=True, backend="eager")
        assert torch.equal(compiled(data)["velocity"], expected)

    def test_transform_rb(self):
        buffer = TensorDictReplayBuffer(
            storage=LazyTensorStorage(4), batch_size=16, transform=InUnitsOf("velocity")
        )
        data = TensorDict(velocity=torch.rand(4, 2), robot=robots(4), batch_size=[4])
        buffer.extend(data)
        for _ in range(2):
            batch = buffer.sample()
            expected = (data["velocity"] / data["robot"][:, 1:2])[batch["index"]]
            torch.testing.assert_close(batch["velocity"], expected)

    def test_transform_inverse(self):
        data = TensorDict(velocity=torch.rand(2), robot=ROBOT)
        assert (InUnitsOf("velocity").inv(data.clone()) == data).all()

    def test_invalid(self):
        line = refused(InUnitsOf("velocity"), velocity=torch.ones(2), robot=torch.ones(3))
        assert line == "robot must have shape [..., 6], got [3]."


def replayed(data: TensorDict, key):
    """A policy that repeats the actions of a rollout."""
    actions = iter(data[key].unbind(data.ndim - 1))
    return lambda tensordict: tensordict.set(key, next(actions))


@pytest.mark.parametrize("how", [copy.deepcopy, lambda one: pickle.loads(pickle.dumps(one))])
@pytest.mark.parametrize(
    "transform",
    [
        HullRange(("a", "lidar"), ("a", "hull"), ("a", "robot")),
        InUnitsOf(("a", "v"), ("a", "robot")),
    ],
)
def test_copies_keep_their_keys(transform, how):
    twin = how(transform)
    assert repr(twin) == repr(transform)
    data = TensorDict(a=TensorDict(lidar=torch.ones(2, 4), v=torch.ones(2, 2), robot=robots(2)))
    assert (twin(data.clone()) == transform(data.clone())).all()


@pytest.mark.parametrize("batch", [(), (3,), (2, 2)])
def test_numbers_of_order_one(batch):
    largest = torch.tensor([0.25, 1.0, math.pi, 2 * math.pi, 10.0, 0.25])
    scaled = RobotScale(max_range=10.0)(largest.expand(*batch, 6))
    torch.testing.assert_close(scaled, torch.ones(*batch, 6))
    half = RobotScale(max_range=10.0)((largest / 2).expand(*batch, 6))
    torch.testing.assert_close(half, torch.full((*batch, 6), 0.5))


@pytest.mark.parametrize("reaches", [4.0, 4.1, 100.0])
def test_a_lidar_reaches_as_far_as_scans_do(reaches):
    scale, robot = RobotScale(max_range=4.0), ROBOT.clone()
    robot[4] = reaches
    assert scale(robot)[4].item() == pytest.approx(0.4)
    robot[4] = 3.0
    assert scale(robot)[4].item() == pytest.approx(0.3)
    assert torch.equal(robot[:4], ROBOT[:4])


@pytest.mark.parametrize("max_range", [0.0, -1.0, math.nan, math.inf])
def test_a_range_that_is_none_is_refused(max_range):
    with pytest.raises(ValueError, match=f"max_range must be positive and finite, got {max_range}"):
        RobotScale(max_range)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("batch", [(), (3,), (2, 2)])
def test_nobody_is_what_is_reported_of_nobody_and_nothing_else(batch, dtype):
    is_nobody = IsNobody(4.0, math.pi)
    nobody = torch.tensor([4.0, math.pi], dtype=dtype).expand(*batch, 2)
    marks = is_nobody(nobody)
    assert marks.dtype == dtype and torch.equal(marks, torch.ones(*batch, 1, dtype=dtype))
    for other in ([4.0, -math.pi], [3.99, math.pi], [4.0, 0.0]):
        assert not is_nobody(torch.tensor(other, dtype=dtype).expand(*batch, 2)).any()
