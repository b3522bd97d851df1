"""A simulation under somebody's hands: the environment's own, with everything where it was put."""

from __future__ import annotations

import re
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from envs import HSR, get_scene
from envs.policy_env import make_policy_env
from recipes.evaluation.setting import Setting, trained_in
from recipes.evaluation.sweep import SHIPPED_POLICY
from recipes.live.simulation import LiveSimulation
from tests import _any_robot as any_robot
from torchrl_morl.deploy import load_policy
from torchrl_morl.transforms import PreferenceSampler


@pytest.fixture(scope="module")
def policy():
    return load_policy(SHIPPED_POLICY)


@pytest.fixture
def make(policy):
    made = []

    def make(scene: str = "showcase", seed: int = 7, policy=policy, **setting) -> LiveSimulation:
        trained = trained_in(policy.card).with_one_robot
        setting = Setting(get_scene(scene), setting.pop("robot", trained.robot), **setting)
        made.append(LiveSimulation(policy, setting, seed=seed))
        return made[-1]

    yield make
    for simulation in made:
        simulation.close()


def drive(simulation: LiveSimulation, steps: int = 300) -> np.ndarray:
    for _ in range(steps):
        simulation.step()
    return np.array(simulation.path)


@pytest.mark.parametrize(
    ("name", "scene"),
    [("polished_seed0", "static"), ("walking", "moving_human"), ("navigation", "moving_human")],
)
def test_untouched_it_is_the_environment(make, policy_folders, name, scene):
    check_untouched(make, load_policy(policy_folders[name]), scene)


@pytest.mark.parametrize("motion", [False, True])
def test_untouched_it_is_the_environment_for_a_policy_of_any_robot(make, tmp_path, motion):
    policy = load_policy(any_robot.save(tmp_path / "any", scene="everyday", motion=motion))
    check_untouched(make, policy, "moving_human", steps=60)


def check_untouched(make, policy, scene: str, steps: int = 300) -> None:
    trained = trained_in(policy.card).with_one_robot
    simulation = make(scene, seed=9, policy=policy, robot=trained.robot)
    simulation.preference = np.array([0.2, 0.5, 0.3])
    path = drive(simulation, steps)
    env = make_policy_env(
        PreferenceSampler(policy.preference_space),
        keep_simulation=True,
        num_envs=1,
        num_threads=1,
        seed=9,
        **{**trained.arguments, "scene": scene},
    )
    start = env.reset()
    start["preference"] = torch.tensor([[0.2, 0.5, 0.3]])
    rollout = env.rollout(steps, policy.actor, auto_reset=False, tensordict=start)
    env.close()
    assert len(path) == rollout.shape[1] + 1
    assert np.allclose(path[1:], rollout["next", "pose"][0, :, :2], atol=1e-4)
    # Whoever has not arrived after these steps is still on its way.
    assert simulation.ending is None or rollout["next", simulation.ending][0, -1]
    assert (simulation.ending is None) != bool(rollout["next", "done"][0, -1])


def test_the_preference_counts_from_the_step_on_in_which_it_changes(make):
    fast, both = make(), make()
    for simulation in (fast, both):
        simulation.preference = np.array([0.0, 0.0, 1.0])
        drive(simulation, 10)
    both.preference = np.array([0.0, 1.0, 0.0])
    drive(fast)
    drive(both)
    assert fast.ending == both.ending == "success"
    assert both.nearest > fast.nearest + 0.4


def test_what_is_moved_stays_there_and_the_robot_goes_on(make):
    simulation = make()
    drive(simulation, 10)
    before = simulation.pose
    simulation.move("human", 4.5, 0.9)
    simulation.move("goal", 8.0, -1.0)
    simulation.move("box1", 5.0, 2.5)
    assert np.allclose(simulation.pose, before)
    path = drive(simulation)
    assert np.allclose(simulation.human, [4.5, 0.9])
    assert np.allclose(simulation.boxes[1, :2], [5.0, 2.5])
    assert simulation.ending == "success"
    assert np.hypot(*(path[-1] - [8.0, -1.0])) < 0.31
    steps = np.hypot(*np.diff(path, axis=0).T)
    assert steps.max() < 0.11  # 0.5 m/s: it never jumped


def test_nobody_can_be_put_into_the_robot(make):
    simulation = make()
    simulation.move("human", *simulation.pose[:2])
    assert simulation.human_distance > 0.427
    simulation.step()
    assert simulation.ending is None


def test_a_hand_gives_people_a_velocity_unless_it_is_too_fast(make, policy_folders):
    """Along the robot's axes, over a control step of 0.2 s: the policy sees who is dragged coming."""
    policy = load_policy(policy_folders["walking"])
    seen = []

    def act(human_velocity, **sensed):
        seen.append(human_velocity[0].tolist())
        return policy.act(human_velocity=human_velocity, **sensed)

    parts = {name: getattr(policy, name) for name in ("card", "sensing", "preference_space")}
    simulation = make(policy=SimpleNamespace(act=act, **parts))
    simulation.step()
    x, y = simulation.human
    heading = simulation.pose[2]
    for place in ((x, y - 0.1), (x + 5, y)):
        simulation.move("human", *place)
        simulation.step()
    assert seen[0] == seen[2] == [0, 0]
    to_the_right = (-0.5 * np.sin(heading), -0.5 * np.cos(heading))
    assert seen[1] == pytest.approx(to_the_right, abs=1e-5)


def test_a_person_crosses_and_comes_back(make):
    simulation = make("empty", seed=7)
    start = simulation.human
    simulation.set_motion("crosses")
    simulation.move("goal", 11.5, 0.0)
    simulation.preference = np.array([0.0, 1.0, 0.0])
    way = []
    while simulation.ending is None and len(way) < 60:
        simulation.step()
        way.append(simulation.human)
    way = np.array(way)
    assert np.allclose(
        way[:, 0], start[0], atol=1e-3
    )  # across the way to the goal, which is along x
    assert way[:, 1].max() - start[1] == pytest.approx(2.5, abs=0.01)
    assert way[-1, 1] < way[:, 1].max() - 1


def test_ways_ahead_are_those_of_the_corner_preferences_and_change_nothing(make):
    simulation = make()
    drive(simulation, 10)
    ways, before = simulation.ways_ahead(40), simulation.pose
    assert ways.shape == (3, 41, 2)
    assert np.allclose(ways[:, 0], before[:2])
    simulation.preference = np.array([0.0, 1.0, 0.0])
    assert np.allclose(drive(simulation, 40)[10:51], ways[1], atol=1e-4)


def test_wheels_and_another_robot_do_as_well(make):
    for simulation in (make(drive="wheels"), make("empty", robot=HSR)):
        drive(simulation)
        assert simulation.ending == "success"


def test_another_scene_and_seed(make):
    simulation = make()
    simulation.enter(get_scene("corridor"))
    assert (len(simulation.boxes), simulation.motion, simulation.seconds) == (4, "stands", 0.0)
    goals = {tuple(simulation.goal)}
    simulation.restart(12)
    goals.add(tuple(simulation.goal))
    assert len(goals) == 2
    simulation.enter(get_scene("moving_human"))
    assert simulation.motion == "walks"


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda s: s.move("box7", 0, 0),
            "there is no 'box7' to move: human, goal and box0 to box2.",
        ),
        (
            lambda s: s.move("goal", float("nan"), 0),
            "must be finite numbers of metres, got nan and 0",
        ),
        (
            lambda s: s.set_motion("runs"),
            "motion must be one of stands, walks, crosses, got 'runs'.",
        ),
    ],
)
def test_what_cannot_be_is_refused(make, call, message):
    simulation = make()
    with pytest.raises(ValueError, match=re.escape(message)):
        call(simulation)
