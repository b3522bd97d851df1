"""What a robot runs: every reason to stop, limits, nobody, a human who walks, and parity with the environment."""

from __future__ import annotations

import dataclasses
import math
import random
from pathlib import Path

import numpy as np
import pytest
import torch

from envs.policy_env import lidar_geometry, make_policy_env
from torchrl_morl.deploy import PolicyRunner, load_policy

from ._stops import LIDAR, NO_INPUTS, PREFERENCE, STOPS, step

POLICIES = Path(__file__).parents[3] / "recipes" / "policies"
NAN, INF = math.nan, math.inf


@pytest.fixture(scope="module")
def policy():
    return load_policy(POLICIES / "polished_seed0")


@pytest.fixture(scope="module")
def walking(policy_folders):
    return load_policy(policy_folders["walking"])


@pytest.fixture
def runner(policy) -> PolicyRunner:
    return PolicyRunner(policy, lidar=LIDAR)


def test_it_drives(runner):
    command = step(runner)
    assert (command.reason, command.detail) == ("drive", "")
    assert 0.0 <= command.speed <= 0.5 and abs(command.turn_rate) <= math.pi
    assert command.valid_until == pytest.approx(10.2)


@pytest.mark.parametrize(("changes", "reason", "detail"), STOPS)
def test_it_stops_and_says_why(runner, changes, reason, detail):
    command = step(runner, **changes)
    assert (command.speed, command.turn_rate, command.reason) == (0.0, 0.0, reason)
    assert detail in command.detail and len(command.detail.splitlines()) == 1
    # And goes on as soon as all is well.
    assert step(runner, 10.4).reason == "drive"


def test_weights_that_overflow_stop_the_robot(policy):
    class Overflowing(torch.nn.Module):
        def forward(self, features):
            return torch.full_like(features[..., :2], NAN)

    actor = torch.nn.ModuleList([torch.nn.Module()])
    actor[0].module = torch.nn.Sequential(Overflowing())
    actor.register_parameter("like", torch.nn.Parameter(torch.zeros(1)))
    broken = dataclasses.replace(policy, actor=actor)
    command = step(PolicyRunner(broken, lidar=LIDAR))
    assert (command.reason, command.speed) == ("refused", 0.0)
    assert "the policy's command is not finite" in command.detail


def test_a_frozen_clock_stops_the_robot_until_it_goes_on(runner):
    assert step(runner, 10.0).reason == "drive"
    stopped = step(runner, 10.0)
    assert (stopped.reason, stopped.speed) == ("clock", 0.0)
    assert stopped.detail == "time is 10.0 s, at the last step it was 10.0 s"
    assert step(runner, 9.0).reason == "clock"  # it went back, as when a bag starts again
    assert step(runner, 9.2).reason == "drive"


def test_frozen_inputs_stop_the_robot_within_a_period(runner):
    reasons = [
        step(runner, 10.0 + 0.2 * k, stamp=min(10.0 + 0.2 * k, 10.4)).reason for k in range(6)
    ]
    assert reasons == ["drive", "drive", "drive", "drive", "stale", "stale"]


def test_a_timeout_of_ones_own(policy):
    runner = PolicyRunner(policy, lidar=LIDAR, timeout=1.0)
    assert step(runner, 10.0, stamp=9.1).reason == "drive"
    assert step(runner, 10.5, stamp=9.4).reason == "stale"


def test_a_goal_radius_of_ones_own(policy):
    runner = PolicyRunner(policy, lidar=LIDAR, goal_radius=0.8)
    assert step(runner, 10.0, goal=(0.8, 0.0)).reason == "goal reached"
    assert step(runner, 10.2, goal=(0.81, 0.0)).reason == "drive"


@pytest.mark.parametrize("limits", [{"max_speed": 0.2}, {"max_turn_rate": 0.1}, {"max_speed": 0.9}])
def test_limits_keep_the_arc(policy, limits):
    free = step(PolicyRunner(policy, lidar=LIDAR), goal=(3.0, 1.0))
    limited = step(PolicyRunner(policy, lidar=LIDAR, **limits), goal=(3.0, 1.0))
    assert limited.speed <= limits.get("max_speed", INF) + 1e-9
    assert abs(limited.turn_rate) <= limits.get("max_turn_rate", INF) + 1e-9
    assert limited.turn_rate * free.speed == pytest.approx(free.turn_rate * limited.speed)
    share = min(
        1.0,
        limits.get("max_speed", INF) / free.speed,
        limits.get("max_turn_rate", INF) / abs(free.turn_rate),
    )
    assert limited.speed == pytest.approx(share * free.speed)


@pytest.mark.parametrize("name", ["goal_radius", "timeout", "max_speed", "max_turn_rate"])
@pytest.mark.parametrize("value", [0.0, -1.0, NAN, INF, "1", True, 10**400])
def test_limits_that_make_no_sense(policy, name, value):
    with pytest.raises(ValueError, match=f"{name} must be finite and positive, got {value!r}"):
        PolicyRunner(policy, lidar=LIDAR, **{name: value})


def test_what_is_no_policy_and_no_lidar(policy):
    with pytest.raises(ValueError, match="policy must be a Policy, from load_policy, got None"):
        PolicyRunner(None, lidar=LIDAR)
    with pytest.raises(ValueError, match="lidar must be a LidarGeometry, got None"):
        PolicyRunner(policy, lidar=None)


@pytest.mark.parametrize(("changes", "reason", "detail"), NO_INPUTS)
def test_it_raises_for_nothing_that_it_is_given(walking, changes, reason, detail):
    given = {"odometry": (0.0, 0.0, 0.0)} | changes
    command = step(PolicyRunner(walking, lidar=LIDAR), 10.0, **given)
    assert (command.reason, command.speed, command.turn_rate) == (reason, 0.0, 0.0)
    assert detail in command.detail and len(command.detail.splitlines()) == 1


def test_a_masked_beam_is_none(runner):
    ranges = np.full(360, 2.0)
    ranges[180] = 0.05 + LIDAR.range_min  # straight ahead
    near = step(runner, 10.0, ranges=ranges)
    masked = step(runner, 10.2, ranges=np.ma.masked_less(ranges, 1.0))
    ranges[180] = NAN
    left_out = step(runner, 10.4, ranges=ranges)
    assert (masked.speed, masked.turn_rate) == (left_out.speed, left_out.turn_rate)
    assert (masked.speed, masked.turn_rate) != (near.speed, near.turn_rate)


def test_a_goal_beyond_the_trained_range_is_the_furthest_of_it(runner, policy):
    furthest = policy.sensing.goal_range[1]
    far, edge = step(runner, 10.0, goal=(40.0, 0.3)), step(runner, 10.2, goal=(furthest, 0.3))
    assert (far.speed, far.turn_rate) == (edge.speed, edge.turn_rate)
    assert far.speed > 0.4


def test_nobody_is_the_one_that_stands_for_nobody(runner, policy):
    nobody = step(runner, 10.0, human=None)
    named = step(runner, 10.2, human=policy.sensing.nobody)
    assert (nobody.speed, nobody.turn_rate) == (named.speed, named.turn_rate)
    assert nobody.reason == "drive"


def test_an_unknown_sector_reads_what_sensing_says(policy):
    blind = dataclasses.replace(LIDAR, first_angle=-math.radians(135), num_beams=271)
    ranges = np.full(271, 2.0)
    command = step(PolicyRunner(policy, lidar=blind), ranges=ranges)
    lidar = blind.sectors(ranges, 30, 4.0)
    lidar[np.isnan(lidar)] = policy.sensing.unknown_range
    expected = policy.act(preference=PREFERENCE, lidar=lidar, goal=(3.0, 0.1), human=(2.0, 0.5))
    np.testing.assert_array_equal([command.speed, command.turn_rate], expected)


# --- a human who walks -------------------------------------------------------------------------


def test_the_velocity_comes_from_two_positions(walking):
    """The robot turns and drives, the human walks north at 0.5 m/s: ahead and left in its frame."""
    runner = PolicyRunner(walking, lidar=LIDAR)
    poses = [(0.0, 0.0, 0.3), (0.1, 0.02, 0.5)]
    humans = [(2.0, 1.0), (2.0, 1.1)]
    seen = []
    for (x, y, heading), (east, north) in zip(poses, humans):
        dx, dy = east - x, north - y
        seen.append((math.hypot(dx, dy), math.atan2(dy, dx) - heading))
    first = step(runner, 10.0, human=seen[0], odometry=poses[0])
    second = step(runner, 10.2, human=seen[1], odometry=poses[1])
    still = {"ranges": np.full(360, INF), "goal": (3.0, 0.1), "preference": PREFERENCE}
    fresh = PolicyRunner(walking, lidar=LIDAR)
    assert first == step(fresh, 10.0, **still, human=seen[0], human_velocity=(0.0, 0.0))
    velocity = (0.5 * math.sin(0.5), 0.5 * math.cos(0.5))
    expected = step(fresh, 10.2, **still, human=seen[1], human_velocity=velocity)
    assert second.speed == pytest.approx(expected.speed, abs=1e-5)
    assert second.turn_rate == pytest.approx(expected.turn_rate, abs=1e-4)


@pytest.mark.parametrize(
    ("later", "second"),
    [(1.3, (2.0, 0.5)), (0.2, (5.0, 0.5))],
    ids=["seen again after a second", "jumps by 3 m"],
)
def test_another_sight_is_a_first_sight(walking, later, second):
    runner, fresh = (PolicyRunner(walking, lidar=LIDAR) for _ in range(2))
    step(runner, 10.0, human=(2.0, 0.5), odometry=(0.0, 0.0, 0.0))
    command = step(runner, 10.0 + later, human=second, odometry=(0.0, 0.0, 0.0))
    expected = step(fresh, 10.0 + later, human=second, human_velocity=(0.0, 0.0))
    assert (command.speed, command.turn_rate) == (expected.speed, expected.turn_rate)


def test_a_velocity_that_is_missing_is_asked_for(walking):
    command = step(PolicyRunner(walking, lidar=LIDAR))
    assert command.reason == "refused"
    assert "this policy reads the human's velocity: give human_velocity=" in command.detail
    assert step(PolicyRunner(walking, lidar=LIDAR), human=None).reason == "drive"
    bad = step(PolicyRunner(walking, lidar=LIDAR), odometry=(NAN, 0.0, 0.0))
    assert bad.reason == "refused" and "odometry must be finite" in bad.detail


# --- with the environment ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "scene"),
    [("polished_seed0", "static"), ("walking", "mixed"), ("hsr", "exploring")],
)
def test_the_runner_commands_what_the_actor_does_in_the_environment(policy_folders, name, scene):
    """Same scans, same commands: the features of training and robot are one implementation."""
    policy = load_policy(policy_folders[name])
    env = make_policy_env(
        policy=policy,
        num_envs=2,
        scene=scene,
        robot=policy.robot,
        seed=3,
        keep_simulation=True,
        observe_human_velocity=policy.sensing.observe_human_velocity,
    )
    runners = [PolicyRunner(policy, lidar=lidar_geometry(env.base_env)) for _ in range(2)]
    data = env.reset()
    data["preference"] = torch.tensor([PREFERENCE] * 2)
    (slow, fast), (right, left) = policy.limits.speed, policy.limits.turn_rate
    for time in range(30):
        data = policy.actor(data)
        action = data["action"].double().numpy()
        for index, runner in enumerate(runners):
            command = runner.step(
                data["scan"][index].numpy(),
                goal=data["goal"][index].numpy(),
                human=data["human"][index].numpy(),
                odometry=data["pose"][index].numpy(),
                preference=PREFERENCE,
                stamp=0.2 * time,
                time=0.2 * time,
            )
            expected = (
                slow + (action[index, 0] + 1) / 2 * (fast - slow),
                right + (action[index, 1] + 1) / 2 * (left - right),
            )
            if command.reason == "goal reached":
                continue
            assert command.reason == "drive", command
            assert command.speed == pytest.approx(expected[0], abs=2e-5)
            assert command.turn_rate == pytest.approx(expected[1], abs=5e-4)
        data = env.step(data)["next"].exclude("reward")
        data["preference"] = torch.tensor([PREFERENCE] * 2)
        if data["done"].any():
            break
    env.close()


def test_a_thousand_random_inputs_never_raise(policy):
    """Whatever a driver sends: a finite command within the limits, and a stop has no speed."""
    rng = random.Random(0)
    runner = PolicyRunner(policy, lidar=LIDAR)
    odd = [None, NAN, INF, -INF, 0.0, -1.0, 1e30, 3.0, "x", (), (1.0,), np.zeros(2), np.nan]

    def pair():
        return rng.choice([(rng.choice(odd), rng.choice(odd)), rng.choice(odd), (3.0, 0.2)])

    for index in range(1000):
        ranges = np.array([rng.choice([0.0, NAN, INF, -INF, 1.0, -1.0, 9.0]) for _ in range(360)])
        command = runner.step(
            rng.choice([ranges, ranges, None, "scan", ranges[:-1]]),
            goal=pair(),
            preference=rng.choice([PREFERENCE, PREFERENCE, pair(), (1, 0, 0)]),
            stamp=rng.choice([index, index, NAN, None, -INF]),
            time=rng.choice([index, index, INF, None]),
            human=pair(),
        )
        assert math.isfinite(command.speed) and math.isfinite(command.turn_rate)
        assert 0.0 <= command.speed <= 0.5 and abs(command.turn_rate) <= math.pi + 1e-6
        assert command.reason == "drive" or command.speed == command.turn_rate == 0.0
