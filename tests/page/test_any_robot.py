"""A policy that reads which robot it drives, on a page: what it senses, commands, and whom it stands beside."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from envs import TURTLEBOT2, Robot, get_robot
from envs.robot_ranges import DRIVEN
from recipes.page.contents import SHIPPED, contents
from tests import _any_robot as any_robot
from torchrl_morl.deploy import load_policy

from ._node import needs_node, node
from .test_parity import check_the_same_episodes, job

pytestmark = needs_node

SMALL = Robot(
    "small",
    radius=0.14,
    max_speed=0.9,
    max_turn_rate=1.5,
    lidar_offset=-0.1,
    lidar_fov=4.0,
    lidar_range=2.5,
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return any_robot.save(tmp_path_factory.mktemp("policies") / "any")


@pytest.mark.parametrize(
    ("scene", "robot", "episodes"),
    [("static", "turtlebot2", 6), ("moving_human", "hsr", 4), ("static", SMALL, 4)],
    ids=["turtlebot2", "hsr", "a lidar that sees less"],
)
def test_the_same_episodes(folder, scene, robot, episodes, tmp_path):
    check_the_same_episodes(str(folder), scene, robot, episodes, tmp_path)


def test_the_same_episodes_of_one_that_reads_how_it_moves(tmp_path_factory, tmp_path):
    folder = any_robot.save(tmp_path_factory.mktemp("policies") / "any", motion=True)
    check_the_same_episodes(str(folder), "static", SMALL, 4, tmp_path)


@pytest.mark.parametrize("robot", ["turtlebot2", "hsr", SMALL])
def test_the_same_commands_as_policy_act_also_beyond_the_training(folder, robot, tmp_path):
    policy, random, robot = load_policy(folder), np.random.default_rng(0), get_robot(robot)
    numbers = [getattr(robot, name) for name in DRIVEN[:6]]
    n = 400
    scan = random.uniform(0.05, 4.5, (n, 720)) ** random.uniform(0.2, 1.0, (n, 1))
    goal = np.stack((random.uniform(0, 30, n), random.uniform(-np.pi, np.pi, n)), -1)
    human = np.stack((random.uniform(0.2, 20, n), random.uniform(-np.pi, np.pi, n)), -1)
    human[::7] = policy.sensing.nobody
    velocity = random.uniform(-1, 1, (n, 2))
    preference = random.dirichlet(np.ones(3), n)
    expected = policy.act(
        preference=preference,
        lidar=scan.reshape(n, 30, 24).min(-1),
        goal=goal,
        human=human,
        human_velocity=velocity,
        robot=numbers,
    )
    inputs = [
        {"scan": s, "goal": g, "human": h, "humanVelocity": v, "preference": p}
        for s, g, h, v, p in zip(*(x.tolist() for x in (scan, goal, human, velocity, preference)))
    ]
    told = {**job(str(folder)), "robot": dataclasses.asdict(robot), "inputs": inputs}
    got = np.array(node("replay.mjs", told, tmp_path)["commands"])
    off = np.abs(got - expected).max(0)
    print(robot.name, f"{off[0]:.1e} m/s, {off[1]:.1e} rad/s")
    assert off[0] < 1e-5
    assert off[1] < 1e-4
    assert got[:, 0].min() >= 0 and got[:, 0].max() <= robot.max_speed
    assert np.abs(got[:, 1]).max() <= robot.max_turn_rate


def test_a_page_drives_a_turtlebot_with_policies_of_any_robot_and_of_that_one(folder):
    page = contents([folder, *SHIPPED], ["showcase"], num_scenes=1)
    assert page["robot"] == dataclasses.asdict(TURTLEBOT2)
    assert list(page["policies"]) == ["any", "navigation", "polished_seed0"]
    entry = page["policies"]["any"]
    assert entry["limits"]["speed"] == (0.0, TURTLEBOT2.max_speed)  # not that of the fastest
    assert entry["sensing"]["observe_robot"] and entry["sensing"]["observe_nobody"]


def test_a_policy_of_another_robot_is_refused_beside_them(folder, tmp_path):
    other = any_robot.save(tmp_path / "theirs", "hsr")
    with pytest.raises(
        ValueError, match=r"its robot is hsr, that of .* is turtlebot2: a page has one"
    ):
        contents([folder, other], ["showcase"], num_scenes=1)


def test_who_was_trained_among_all_sorts_of_people_knows_who_walks_and_who_stands(tmp_path):
    folder = any_robot.save(tmp_path / "any", scene="everyday")
    page = contents([folder, *SHIPPED], ["showcase"], num_scenes=1)
    assert [one["walking"] for one in page["policies"].values()] == [None, None, False]
