"""What a lifecycle manager sees, and bad parameters: one line each."""

from __future__ import annotations

import time

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.srv import GetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from torchrl_morl_ros.node import PolicyNode

from ._robot import POLICY, STARTS, NodeProcess, Robot


@pytest.fixture(scope="module")
def robot(loopback):
    # Slower than the wall's clock: these tests are about states, on machines that may be busy.
    robot = Robot(seed=7, factor=0.5)
    yield robot
    robot.close()


@pytest.fixture(scope="module")
def unconfigured(loopback, robot):
    node = NodeProcess(loopback / "unconfigured.log", autostart="false")
    assert state(robot) == State.PRIMARY_STATE_UNCONFIGURED
    yield node
    assert node.end() == 0


def change(robot: Robot, transition: int) -> bool:
    request = ChangeState.Request(transition=Transition(id=transition))
    return robot.ask(ChangeState, "change_state", request).success


def state(robot: Robot) -> int:
    return robot.ask(GetState, "get_state", GetState.Request()).current_state.id


def test_it_is_managed(loopback, robot):
    node = NodeProcess(
        loopback / "managed.log", autostart="false", policy="/nowhere", use_sim_time="true"
    )
    assert state(robot) == State.PRIMARY_STATE_UNCONFIGURED
    assert not change(robot, Transition.TRANSITION_CONFIGURE)
    assert "not configured: /nowhere/policy.safetensors not found" in node.said()
    assert robot.set_parameter("policy", str(POLICY)).successful
    assert change(robot, Transition.TRANSITION_CONFIGURE)
    assert state(robot) == State.PRIMARY_STATE_INACTIVE
    robot.send_goal()
    robot.rest(0.5)
    assert "a goal is not taken: the node is not active" in node.said()
    assert robot.commands == []
    assert change(robot, Transition.TRANSITION_ACTIVATE)
    assert robot.run(lambda: robot.reason == "no goal", 10)
    robot.send_goal()
    assert robot.run(lambda: robot.velocity[0] > 0.2, 20)
    # What cannot be done now does not touch a robot that drives.
    assert not change(robot, Transition.TRANSITION_CONFIGURE)
    assert robot.reason == "drive"
    assert change(robot, Transition.TRANSITION_DEACTIVATE)
    assert robot.run(lambda: robot.stands, 5)
    assert robot.reason == "inactive"
    # It does not set off by itself when it is active again.
    assert change(robot, Transition.TRANSITION_ACTIVATE)
    assert robot.run(lambda: robot.reason == "no goal", 10)
    assert change(robot, Transition.TRANSITION_DEACTIVATE)
    assert change(robot, Transition.TRANSITION_CLEANUP)
    assert state(robot) == State.PRIMARY_STATE_UNCONFIGURED
    assert change(robot, Transition.TRANSITION_CONFIGURE)
    assert node.end() == 0


@pytest.mark.parametrize(
    ("name", "value", "line"),
    [
        ("policy", "", "policy must be the folder of a policy, got ''"),
        ("publish_rate", 2.0, "publish_rate must be from 5 to 200 Hz, got 2.0"),
        (
            "human_message",
            "people_msgs/msg/People",
            "human_message is 'people_msgs/msg/People', and people_msgs is not installed: apt",
        ),
        ("human_message", "somebody", "human_message must be one of none, geometry_msgs/msg/Pose"),
        ("preference", [0.5, 0.5], "preference must be 3 weights from 0 to 1 that sum to 1"),
        ("base_frame_id", "", "base_frame_id must be the name of a frame, got ''"),
    ],
)
def test_a_parameter_that_makes_no_sense_is_a_line(robot, unconfigured, name, value, line):
    before = robot.ask(GetParameters, "get_parameters", GetParameters.Request(names=[name]))
    assert robot.set_parameter(name, value).successful
    lines = len(unconfigured.said().splitlines())
    assert not change(robot, Transition.TRANSITION_CONFIGURE)
    assert robot.run(lambda: len(unconfigured.said().splitlines()) > lines, 5)
    said = [one for one in unconfigured.said().splitlines()[lines:] if "[ERROR]" in one]
    assert len(said) == 1
    assert f"not configured: {line}" in said[0]
    if name != "preference":
        assert robot.set_parameter(name, before.values[0].string_value or 50.0).successful
    else:
        assert robot.set_parameter(name, [0.2, 0.5, 0.3]).successful


def test_a_transition_out_of_order_is_refused_and_the_node_lives_on(robot, unconfigured):
    # A lifecycle manager may ask for what has been done: `autostart` beside it, or a manager that restarts.
    assert not change(robot, Transition.TRANSITION_ACTIVATE)
    assert "a transition is refused: activate" in unconfigured.said()
    assert "from state unconfigured" in unconfigured.said()
    assert state(robot) == State.PRIMARY_STATE_UNCONFIGURED
    assert unconfigured.process.poll() is None


@pytest.mark.parametrize(
    ("parameter", "line"),
    [
        (
            {"publish_rate": "20"},
            "policy_node: error: Trying to set parameter 'publish_rate' to '20' of type 'INTEGER', "
            "expecting type 'DOUBLE': publish_rate. Write every number with a point: 1.0, not 1.",
        ),
        (
            {"robot": "[0.2, 1, 3.0, 6.28, 4.0, 0.0]"},
            "Sequence should be of same type",
        ),
    ],
)
def test_a_parameter_of_another_type_ends_it(loopback, parameter, line):
    node = NodeProcess(loopback / "type.log", **parameter)
    assert node.process.wait(STARTS) == 1
    said = node.said().splitlines()[-1]
    assert line in said
    assert said.startswith("policy_node: error: ")
    assert said.endswith(". Write every number with a point: 1.0, not 1.")


def test_a_start_that_fails_ends_it(loopback):
    node = NodeProcess(loopback / "start.log", policy="/nowhere")
    assert node.process.wait(STARTS) == 1
    (said,) = node.said().splitlines()
    assert "not configured: /nowhere/policy.safetensors not found: a policy is a folder" in said


def test_robots_of_two_namespaces_tell_who_they_are(loopback):
    heard = []
    listener = rclpy.create_node("listener")
    listener.create_subscription(
        DiagnosticArray, "/diagnostics", lambda m: heard.append(m.status[0].name), 10
    )
    given = [Parameter("policy", value=str(POLICY)), Parameter("human_message", value="none")]
    node = PolicyNode(namespace="robot1", parameter_overrides=given)
    executor = SingleThreadedExecutor()
    executor.add_node(listener)
    executor.add_node(node)
    node.trigger_configure()
    end = time.monotonic() + 30
    while "robot1/policy_node: policy" not in heard and time.monotonic() < end:
        executor.spin_once(timeout_sec=0.1)
    node.trigger_cleanup()
    for one in (node, listener):
        one.destroy_node()
    assert "robot1/policy_node: policy" in heard
