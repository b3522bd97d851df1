"""The robot arrives, under any preference, and as the library's own runner would drive. On /clock."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from geometry_msgs.msg import TwistStamped
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.parameter import Parameter

from envs.policy_env import lidar_geometry
from torchrl_morl.deploy import PolicyRunner, load_policy

from ._robot import POLICY, STARTS, Moment, NodeProcess, Robot

CORNERS = {
    "demonstration": (1.0, 0.0, 0.0),
    "distance": (0.0, 1.0, 0.0),
    "efficiency": (0.0, 0.0, 1.0),
}

STEPS = itertools.count()
"""A clock for the runner that is compared with: it never stands still."""


@pytest.fixture(scope="module")
def robot(loopback):
    robot = Robot(
        seed=7,
        factor=3.0,
        human_message="geometry_msgs/msg/PoseArray",
        enable_stamped_cmd_vel=True,
    )
    yield robot
    robot.close()


@pytest.fixture(scope="module", autouse=True)
def node(loopback, robot):
    node = NodeProcess(
        loopback / "node.log",
        use_sim_time="true",
        human_message="geometry_msgs/msg/PoseArray",
        enable_stamped_cmd_vel="true",
    )
    assert robot.run(lambda: robot.reason != "", STARTS), node.said()
    yield node
    assert node.end() == 0


def begin(robot: Robot) -> None:
    robot.begin()
    robot.rest(0.5)
    robot.moments.clear()
    robot.commands.clear()
    robot.send_goal()
    assert robot.run(lambda: robot.reason == "drive", 10), robot.told[-1]


def agreement(robot: Robot, preference, since: float = 0.0) -> float:
    """Share of the commands that are those of the library for what the robot sensed."""
    runner = PolicyRunner(load_policy(POLICY), lidar=lidar_geometry(robot.env))
    found, last = [], None
    for when, *command in robot.commands:
        if when < since or command in ([0.0, 0.0], last):  # standing, or sent again
            continue
        last = command
        # Scan and pose are messages of their own: a step may see one of them a little later.
        near = [one for one in robot.moments if when - 0.35 < one.time <= when + 0.01]
        found.append(
            any(
                np.allclose(command, expected(runner, scan, pose, preference), atol=1e-4)
                for scan, pose in itertools.product(near, near)
            )
        )
    assert len(found) > 10
    return float(np.mean(found))


def expected(runner: PolicyRunner, scan: Moment, pose: Moment, preference) -> tuple[float, float]:
    time = next(STEPS)
    command = runner.step(
        scan.scan, goal=pose.goal, human=pose.human, preference=preference, stamp=time, time=time
    )
    return command.speed, command.turn_rate


@pytest.mark.parametrize("name", CORNERS)
def test_it_arrives_and_drives_as_the_library(robot, name):
    preference = CORNERS[name]
    if name == "distance":
        robot.prefer(*preference)
        told = "preference distance"
        assert robot.run(lambda: robot.told[-1][1][told] == "1.000", 20)
    else:
        assert robot.set_parameter("preference", list(preference)).successful
    begin(robot)
    assert robot.run(lambda: robot.ended, 60)
    assert robot.succeeded
    assert agreement(robot, preference) > 0.97
    assert robot.run(lambda: robot.reason == "goal reached", 10), robot.told[-1]
    robot.rest(1.0)
    assert robot.stands


def test_a_preference_that_changes_while_it_drives(robot):
    before, after = CORNERS["distance"], CORNERS["efficiency"]
    robot.prefer(*before)
    begin(robot)
    robot.rest(3.0)
    changed = robot.now
    robot.prefer(*after)
    robot.rest(5.0)
    later = changed + 0.4
    assert agreement(robot, after, since=later) > 0.97
    assert agreement(robot, before, since=later) < 0.5
    assert robot.told[-1][1]["preference efficiency"] == "1.000"
    assert robot.reason == "drive"


def test_a_preference_off_the_simplex_is_refused_and_the_last_one_holds(robot, node):
    assert robot.set_parameter("preference", [0.0, 0.5, 0.5]).successful
    answer = robot.set_parameter("preference", [0.5, 0.5, 0.5])
    assert not answer.successful
    assert answer.reason.startswith(
        "preference must be 3 weights from 0 to 1 that sum to 1, for demo"
    )
    robot.prefer(0.2, 0.8)
    assert robot.run(lambda: "got [0.2, 0.8]. The last one holds." in node.said(), 10)
    robot.rest(4.0)
    assert robot.told[-1][1]["preference distance"] == "0.500"


def test_what_is_read_when_configured_is_refused_later(robot):
    answer = robot.set_parameter("max_speed", 0.1)
    assert not answer.successful
    assert answer.reason == "max_speed is read when the node is configured: clean it up first"


def test_a_preference_that_is_set_with_what_is_refused_is_not_taken(robot):
    assert robot.set_parameter("preference", [0.0, 0.5, 0.5]).successful
    both = [Parameter("preference", value=[1.0, 0.0, 0.0]), Parameter("max_speed", value=0.1)]
    request = SetParametersAtomically.Request(parameters=[one.to_parameter_msg() for one in both])
    assert not robot.ask(
        SetParametersAtomically, "set_parameters_atomically", request
    ).result.successful
    told = len(robot.told)
    assert robot.run(lambda: len(robot.told) > told + 1, 30)
    assert robot.told[-1][1]["preference demo"] == "0.000"


def test_another_node_on_the_same_topic_is_told(robot, node):
    begin(robot)
    assert robot.told[-1][1]["others that publish cmd_vel"] == "0"
    other = robot.create_publisher(TwistStamped, "cmd_vel", 1)
    assert robot.run(lambda: robot.told[-1][1]["others that publish cmd_vel"] == "1", 20)
    assert "others publish /cmd_vel as well (1): the base gets both their commands" in node.said()
    robot.destroy_publisher(other)
    assert robot.run(lambda: robot.told[-1][1]["others that publish cmd_vel"] == "0", 20)


def test_a_clock_that_stands_still(robot, node):
    begin(robot)
    robot.rest(1.0)
    factor, robot.factor = robot.factor, 0.02  # a step every 2.5 s of the wall
    assert robot.run(lambda: robot.reason == "clock", 15), robot.told[-1]
    assert "use_sim_time is true: does anybody publish /clock?" in robot.told[-1][1]["detail"]
    # A stop that somebody has to look after is a warning.
    told = [one for one in node.said().splitlines() if "]: clock: " in one]
    assert told and all(one.startswith("[WARN]") for one in told)
    robot.factor = factor
    assert robot.run(lambda: robot.reason == "drive", 10), robot.told[-1]
