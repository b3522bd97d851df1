"""Robots that differ from episode to episode, in the simulation and in what a policy observes."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torchrl.envs.utils import check_env_specs

from envs import ANY_ROBOT, NavigationEnv, RobotRanges, get_robots
from envs.policy_env import contract, make_policy_env, sensing
from envs.robot_ranges import DRIVEN
from torchrl_morl.deploy import Sensing
from torchrl_morl.deploy.features import RowFeatures, observation
from torchrl_morl.deploy.policy import Policy
from torchrl_morl.testing import untrained_policy

OBSERVED = {"observe_nobody": True, "observe_robot": True, "observe_human_velocity": True}


def make_env(**kwargs) -> NavigationEnv:
    return NavigationEnv(**{"robot": "any", "num_envs": 16, "num_threads": 1, "seed": 0, **kwargs})


def test_robots_are_drawn_from_their_ranges():
    robots = ANY_ROBOT.draw(2000, torch.Generator().manual_seed(0))
    for column, name in enumerate(DRIVEN):
        low, high = getattr(ANY_ROBOT, name)
        drawn = robots[:, column] / (robots[:, 0] if name == "lidar_offset" else 1.0)
        assert low <= drawn.min() < low + 0.1 * (high - low), name
        assert high - 0.1 * (high - low) < drawn.max() <= high, name


def test_who_has_far_to_go_is_not_slow():
    slowest = torch.tensor([0.1, 0.5, 3.0], dtype=torch.float64).repeat(100)
    speed = ANY_ROBOT.draw(300, torch.Generator().manual_seed(0), slowest)[:, 1]
    assert speed[0::3].min() < 0.35 and speed[1::3].min() >= 0.5 and (speed[2::3] == 1.0).all()


def test_each_drives_at_its_own_limits_and_is_touched_at_its_own_radius():
    env = make_env(scene="empty", report_robot=True)
    data = env.reset()
    robot = data["robot"].double()
    assert torch.unique(robot[:, 1]).numel() == torch.unique(robot[:, 0]).numel() == 16
    for _ in range(12):
        data = env.step(data.set("action", torch.tensor([[1.0, 0.5]] * 16)))["next"]
    speed = data["qvel"][:, :2].norm(dim=-1)
    # A robot that turns through its first-order servo loses a little of its speed.
    assert torch.allclose(speed, robot[:, 1], rtol=0.2)
    assert torch.allclose(data["qvel"][:, 2], 0.5 * robot[:, 2], rtol=0.02)
    gap = (data["pose"][:, :2] - data["human_pose"][:, :2]).norm(dim=-1) - 0.25
    assert ((gap <= robot[:, 0]) <= data["collision_human"][:, 0]).all()


def test_each_sees_with_its_own_lidar():
    env, full = make_env(scene="empty", max_range=10.0), make_env(scene="empty", robot="turtlebot2")
    scan, robots = env.reset()["scan"], torch.from_numpy(env.robots.numbers)
    assert full.reset()["scan"].max() <= 4.0
    angle = 2 * math.pi * torch.arange(720) / 720
    away = torch.minimum(angle, 2 * math.pi - angle)
    for row in range(16):
        outside = away > robots[row, 3] / 2 + 1e-6
        assert (scan[row][outside] == 10.0).all()
        assert ((scan[row] <= robots[row, 4]) | (scan[row] == 10.0)).all()


@pytest.mark.parametrize("snapshots", [True, False])
def test_specs(snapshots):
    check_env_specs(make_env(num_envs=3, report_robot=True, snapshots=snapshots, num_rays=30))


def test_a_snapshot_remembers_the_robot():
    env = make_env(num_envs=4)
    torch.manual_seed(0)
    rollout = env.rollout(6, break_when_any_done=False)
    before = env.robots.numbers.copy()
    env.reset()
    assert not np.array_equal(env.robots.numbers, before)
    restored = env.reset(rollout[:, 5].exclude("next"), set_state=True)
    assert torch.equal(restored["scan"], rollout["scan"][:, 5])
    assert np.array_equal(env.robots.numbers, rollout["scene", "robot"][:, 5].numpy())


def test_ranges_in_a_mapping():
    ranges = get_robots({"name": "mine", "radius": [0.2, 0.3], "max_speed": 0.6})
    assert isinstance(ranges, RobotRanges) and ranges.max_speed == (0.6, 0.6)
    assert ranges.largest.radius == 0.3
    assert not isinstance(get_robots({"radius": 0.2}), RobotRanges)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"radius": [0.3, 0.2]}, r"radius must be a number or a range \[low, high\], got"),
        ({"max_speed": [0.3, 0.5]}, "radius is missing"),
        ({"radius": [0.2, 0.3], "mass": 3.0}, "mass cannot stand beside a range"),
        ({"radius": [0.2, 3.0]}, "radius must be a number above 0 and at most 2"),
        ({"radius": [0.2, 0.3], "lidar_offset": 2.0}, "shares of the radius from -1 to 1"),
    ],
)
def test_what_is_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        get_robots(fields)


def test_wheels_are_refused():
    with pytest.raises(ValueError, match="drive must be 'planar' for robots that differ"):
        make_env(drive="wheels")


# --- what a policy observes


def test_the_observation_in_closed_form():
    reads = Sensing(num_sectors=2, **OBSERVED)
    robot = torch.tensor([0.25, 0.5, math.pi, math.pi, 5.0, 0.0])
    features = observation(
        reads,
        lidar=torch.tensor([4.25, 0.45]),
        goal=torch.tensor([5.0, 0.0]),
        human=torch.tensor([2.0, 0.0]),
        human_velocity=torch.tensor([1.0, -0.5]),
        nobody=torch.zeros(1),
        robot=robot,
    )
    expected = [0.0, math.log(0.2 / 4) / 3, 1, 0, 1, 1, 0, 1, 2, -1, 0, 1, 0.5, 1, 0.5, 0.4, 0]
    assert features.tolist() == pytest.approx(expected, abs=1e-6)
    row = torch.cat(
        [torch.tensor([4.25, 0.45, 5, 0, 2, 0, 1, -0.5, 0]), robot, torch.tensor([0.2, 0.8])]
    )
    whole = RowFeatures(reads, 2, like=row)(row)
    assert whole.tolist() == pytest.approx([*expected, 0.2, 0.8], abs=1e-6)


def test_training_and_policy_see_the_same():
    arguments = {"scene": "everyday", "robot": "any", **OBSERVED}
    env = make_policy_env(num_envs=12, num_threads=1, seed=1, keep_simulation=True, **arguments)
    reads = sensing(arguments)
    assert reads.observation_size == env.observation_spec["observation"].shape[-1] == 45
    data = env.rollout(4, break_when_any_done=False)
    features = observation(
        reads,
        lidar=data["lidar"],
        goal=data["goal"],
        human=data["human"],
        # Which the environment keeps among the features alone, in units of the top speed.
        human_velocity=data["observation"][..., 36:38] * data["robot"][..., 1:2],
        nobody=(data["human"] == torch.tensor([4.0, math.pi])).all(-1, keepdim=True).float(),
        robot=data["robot"],
    )
    torch.testing.assert_close(features, data["observation"])
    check_env_specs(env)


def test_a_policy_commands_within_the_robot_s_limits():
    base = untrained_policy(sensing=sensing({"robot": "any", **OBSERVED}))
    policy = Policy(base.actor, base.preference_space, base.sensing, base.limits, 0.2, "any", {})
    inputs = {"preference": [0, 0, 1], "lidar": [4.0] * 30, "goal": [6.0, 0.5]}
    slow, fast = (
        policy.act(robot=[0.2, speed, 2.0, 6.28, 4.0, 0.0], **inputs) for speed in (0.3, 0.6)
    )
    assert 0 < slow[0] < 0.3 and abs(slow[1]) < 2.0 and not np.allclose(slow, fast)
    with pytest.raises(ValueError, match="give robot=, its radius"):
        policy.act(**inputs)
    with pytest.raises(ValueError, match="limits, view and range above 0"):
        policy.act(robot=[0.2, 0.0, 2.0, 6.28, 4.0, 0.0], **inputs)


def test_the_contract_of_robots_that_differ():
    facts = contract({"robot": "any", "observe_robot": True})
    assert facts["robot"] == "any" and facts["limits"].speed == (0.0, 1.0)
    assert facts["sensing"].observe_robot


def test_scenes_of_a_block_are_for_robots_of_all_sizes():
    env = NavigationEnv(scene="static", robot="any", num_envs=128, num_threads=1, seed=0)
    radius = env.reset()["robot"][:, 0]
    low, high = ANY_ROBOT.radius
    assert radius.min() >= low and radius.max() <= high
    quarters = ((radius - low) / (high - low) * 4).long().clamp(0, 3)
    assert torch.bincount(quarters, minlength=4).tolist() == [32, 32, 32, 32]


def test_the_same_seed_gives_the_same_scenes_again():
    """The second time they are not drawn, and what comes after them is as it was."""
    env = NavigationEnv(scene="crossing", robot="any", num_envs=4, num_threads=1, seed=5)
    first = [env.reset()["scene"].clone() for _ in range(40)]
    env.set_seed(5)
    again = [env.reset()["scene"] for _ in range(40)]
    for one, other in zip(first, again):
        assert (one == other).all()
