"""Objectives and their constants: numbers by hand, the order of the reward, and what is refused."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from torchrl.envs.utils import check_env_specs

from envs import OBJECTIVES, NavigationEnv, RewardConstants
from envs.navigation_task import NavigationTask
from envs.policy_env import make_policy_env
from envs.scenes import HUMAN_RADIUS
from envs.straight_drive import StraightDriveValue
from torchrl_morl.deploy.features import OBSERVATION_SIZE
from torchrl_morl.geometry import point_box_distance

ALL = ("core", "distance", "efficiency", "clearance")


def _task(num_envs: int, num_boxes: int, **kwargs) -> NavigationTask:
    """Robots of 0.2 m at the origin; goals, humans and boxes are far away."""
    task = NavigationTask(num_envs, num_boxes, robot_radius=0.2, goal_radius=0.3, **kwargs)
    task.goal[:], task.human_pose[:, :2], task.boxes[..., :2] = 30.0, -30.0, 60.0
    task.boxes[..., 3:] = 0.5
    return task


def _begin(task: NavigationTask) -> np.ndarray:
    position = np.zeros_like(task.goal)
    task.begin(np.arange(len(position)), position)
    task.end()
    return position


def test_clearance_by_hand():
    task = _task(5, 2, objectives=("clearance",))
    # From the hull to the box: 1 m, a half, a tenth, touching, and inside.
    task.boxes[:, 1, 0] = [1.7, 1.2, 0.8, 0.7, 0.5]
    task.boxes[:, 1, 1] = 0.0
    before = _begin(task)
    np.testing.assert_allclose(task.clearance(), [1.0, 0.5, 0.1, 0.0, 0.0], atol=1e-12)
    expected = [[0.0], [-2.5], [-8.1], [-10.0], [-10.0]]
    np.testing.assert_allclose(task.reward(before), expected, atol=1e-9)


def test_clearance_is_the_distance_to_the_nearest_box():
    rng = np.random.default_rng(0)
    task = _task(500, 3)
    task.boxes[..., :2] = rng.uniform(-2, 2, (500, 3, 2))
    task.boxes[..., 2] = rng.uniform(-math.pi, math.pi, (500, 3))
    task.boxes[..., 3:] = rng.uniform(0.05, 1.0, (500, 3, 2))
    _begin(task)
    distance = point_box_distance(torch.zeros(500, 1, 2), torch.from_numpy(task.boxes)).amin(1)
    np.testing.assert_allclose(task.clearance(), (distance - 0.2).clamp_min(0), atol=1e-12)


def test_without_boxes_nothing_is_near():
    task = _task(2, 0, objectives=("clearance",))
    assert (task.reward(_begin(task)) == 0).all()


def test_constants_by_hand():
    rewards = RewardConstants(
        goal_reward=10.0,
        collision_reward=-7.0,
        style_penalty=-2.0,
        distance_threshold=1.5,
        distance_minimum=0.5,
        clearance_threshold=0.5,
    )
    task = _task(1, 1, objectives=ALL, rewards=rewards)
    task.goal[:], task.human_pose[:, :2], task.boxes[:, 0, :2] = (
        (3.0, 0.0),
        (0.0, 1.0),
        (0.0, -0.95),
    )
    _begin(task)
    # From one metre farther: 10 a metre. 0.5 m within the threshold of the human, 0.25 m from the box.
    reward = task.reward(np.array([[-1.0, 0.0]]))
    np.testing.assert_allclose(reward, [[10.0, -2 * 0.5**2, -2.0, -2 * 0.5**2]], atol=1e-9)
    task.boxes[:, 0, :2] = (0.0, -0.6)
    before = _begin(task)
    assert task.flags.tolist() == [[False, False, True]]
    np.testing.assert_allclose(task.reward(before)[0, 0], -7.0)


@pytest.mark.parametrize(("gap", "cost"), [(0.5, 0.0), (0.3, 0.0), (0.15, 50.0), (0.06, 80.0)])
def test_discomfort_by_hand(gap, cost):
    """From 0.3 m on nothing, in the middle half: whichever the robot's radius."""
    rewards = RewardConstants(discomfort_reward=-100.0)
    radius = np.array([0.12, 0.35])
    task = NavigationTask(2, 0, robot_radius=radius, goal_radius=0.3, rewards=rewards)
    task.goal[:] = (3.0, 0.0)
    task.human_pose[:, 0] = -(gap + radius + HUMAN_RADIUS)
    before = _begin(task)
    np.testing.assert_allclose(task.reward(before)[:, 0], -cost, atol=1e-9)


def test_the_reward_has_the_objectives_in_their_order():
    kwargs = {"num_envs": 4, "num_threads": 1, "seed": 0}
    default = NavigationEnv(**kwargs)
    assert default.objectives == NavigationEnv.objectives == ("core", "distance", "efficiency")
    env = NavigationEnv(objectives=("clearance", "efficiency", "core", "distance"), **kwargs)
    assert env.objectives == ("clearance", "efficiency", "core", "distance")
    assert NavigationEnv.objectives == ("core", "distance", "efficiency")
    assert env.reward_spec.shape == (4, 4)
    check_env_specs(env)
    rewards = []
    for one in (default, env):
        one.set_seed(3)
        data, summed = one.reset(), []
        for _ in range(60):
            data = one.step(data.set("action", torch.tensor([[0.5, 0.1]] * 4)))["next"]
            summed.append(data["reward"].clone())
        rewards.append(torch.stack(summed))
    assert torch.equal(rewards[1][..., [2, 3, 1]], rewards[0])
    clearance = rewards[1][..., 0]
    assert -10 <= clearance.min() < 0 == clearance.max()


def test_a_mapping_or_a_configuration_gives_the_constants():
    given = {"goal_reward": 10, "style_penalty": -1.0}
    for rewards in (given, OmegaConf.create(given), RewardConstants(**given)):
        env = make_policy_env(num_envs=1, rewards=rewards, objectives=["core", "efficiency"])
        assert env.base_env.rewards == RewardConstants(goal_reward=10, style_penalty=-1.0)
        assert env.rollout(1)["next", "reward"][0, 0, 1] == -1.0
    assert NavigationEnv(rewards=None).rewards == RewardConstants()


def test_the_value_of_the_straight_drive_takes_the_same_constants():
    observation = torch.zeros(OBSERVATION_SIZE)
    observation[30] = 2.0 / 5.0
    names = ("core", "clearance", "efficiency")
    value = StraightDriveValue(names, gamma=1.0, rewards={"goal_reward": 10, "style_penalty": -1})
    torch.testing.assert_close(value(observation), torch.tensor([17.0, 0.0, -17.0]))


@pytest.mark.parametrize(
    ("rewards", "message"),
    [
        ({"goal_reward": 0}, "rewards: goal_reward must be a number above 0, got 0"),
        ({"goal_reward": "125"}, "goal_reward must be a number above 0, got '125'"),
        ({"collision_reward": 1000}, "collision_reward must be a number, at most 0, got 1000"),
        ({"style_penalty": 10}, "style_penalty must be a number below 0, got 10"),
        ({"style_penalty": math.nan}, "style_penalty must be a number below 0, got nan"),
        ({"distance_minimum": 2.0}, r"below distance_threshold \(2.0\), got 2.0"),
        ({"distance_minimum": -0.1}, "distance_minimum must be a number of metres, from 0"),
        ({"distance_threshold": None}, "distance_threshold must be a number of metres above 0"),
        ({"discomfort_reward": 1}, "discomfort_reward must be a number, at most 0"),
        ({"discomfort_distance": 0}, "discomfort_distance must be a number of metres above 0"),
        ({"clearance_threshold": 0}, "clearance_threshold must be a number of metres above 0"),
        ({"goal": 125}, "rewards: unknown constant 'goal': choose among .'goal_reward'"),
        (125, "rewards must be an envs.RewardConstants or a mapping, got 125"),
    ],
)
def test_constants_that_are_refused(rewards, message):
    with pytest.raises(ValueError, match=message) as error:
        NavigationEnv(rewards=rewards)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("objectives", "message"),
    [
        ("core", "objectives must be a list of names, got 'core'"),
        ((), "objectives must be a list of names"),
        (None, "objectives must be a list of names, got None"),
        (("core", "speed"), r"Unknown objective 'speed': choose among \['core', 'distance'"),
        (("core", ["distance"]), "Unknown objective"),
        (("core", "core"), r"objectives must differ, got \['core', 'core'\]"),
        (("core", "demo"), "Unknown objective 'demo'"),
    ],
)
def test_objectives_that_are_refused(objectives, message):
    with pytest.raises(ValueError, match=message):
        NavigationEnv(objectives=objectives)


def test_another_objective_is_a_function_and_an_entry(monkeypatch):
    def hurry(task, before):
        return -task.distance[0]

    monkeypatch.setitem(OBJECTIVES, "hurry", hurry)
    env = NavigationEnv(objectives=("core", "hurry"), num_envs=2, num_threads=1, seed=0)
    step = env.rollout(1)["next"]
    torch.testing.assert_close(step["reward"][..., 1], -step["goal"][..., 0])


@pytest.mark.parametrize(
    ("objective", "got"),
    [
        (lambda task, before: None, "got None"),
        (lambda task, before: -1.0, "got -1.0"),
        (lambda task, before: [0.0] * len(before), "got [0.0, 0.0, 0.0]"),
        (lambda task, before: np.zeros((len(before), 1)), "got one of shape [3, 1]"),
        (lambda task, before: np.zeros(1), "got one of shape [1]"),
        (lambda task, before: np.zeros(len(before), complex), "got one of complex128"),
        (lambda task, before: np.full(len(before), "far"), "got one of <U3"),
        (lambda task, before: torch.zeros(len(before)), "got tensor([0., 0., 0.])"),
        (lambda task, before: np.array([0.0, np.nan, 0.0]), "got nan in environment 1"),
        (lambda task, before: np.array([0.0, 0.0, -np.inf]), "got -inf in environment 2"),
    ],
)
def test_what_an_objective_returns_is_refused_by_its_name(objective, got, monkeypatch):
    monkeypatch.setitem(OBJECTIVES, "mine", objective)
    env = NavigationEnv(num_envs=3, seed=0, objectives=("core", "mine"))
    with pytest.raises(ValueError) as error:
        env.rollout(2)
    allowed = "objective 'mine' must return an array of 3 finite numbers, one an environment"
    assert str(error.value) == f"{allowed}, {got}."


def test_an_objective_of_whole_numbers_or_of_one_bit(monkeypatch):
    monkeypatch.setitem(OBJECTIVES, "mine", lambda task, before: task.flags[:, 0])
    env = NavigationEnv(num_envs=3, seed=0, objectives=("core", "mine"))
    assert (env.rollout(2)["next", "reward"][..., 1] == 0).all()


def test_an_entry_that_is_no_function_is_refused(monkeypatch):
    monkeypatch.setitem(OBJECTIVES, "mine", -1.0)
    with pytest.raises(ValueError, match=r"OBJECTIVES\['mine'\] must be a function .* got -1.0"):
        NavigationEnv(objectives=("mine",))
