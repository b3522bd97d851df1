"""What a lifecycle manager sees, and bad parameters: one line each."""

from __future__ import annotations

import pytest
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState

from ._robot import POLICY, STARTS, NodeProcess, Robot


@pytest.fixture(scope="module")
def robot(loopback):
    robot = Robot(seed=7)
    yield robot
    robot.close()


def call(robot: Robot, kind, name: str, request):
    client = robot.create_client(kind, f"/policy_node/{name}")
    assert robot.run(client.service_is_ready, STARTS)
    future = client.call_async(request)
    assert robot.run(future.done, 30)
    robot.destroy_client(client)
    return future.result()


def change(robot: Robot, transition: int) -> bool:
    request = ChangeState.Request(transition=Transition(id=transition))
    return call(robot, ChangeState, "change_state", request).success


def state(robot: Robot) -> int:
    return call(robot, GetState, "get_state", GetState.Request()).current_state.id


def test_it_is_managed(loopback, robot):
    node = NodeProcess(loopback / "managed.log", autostart="false", policy="/nowhere")
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
    assert robot.run(lambda: robot.velocity[0] > 0.2, 10)
    assert change(robot, Transition.TRANSITION_DEACTIVATE)
    assert robot.run(lambda: robot.stands, 1)
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
    ("parameters", "line"),
    [
        ({"policy": ""}, "policy must be the folder of a policy, got ''"),
        ({"publish_rate": "2.0"}, "publish_rate must be from 5 to 200 Hz, got 2.0"),
        ({"publish_rate": "20"}, "publish_rate"),
        ({"human_message": "people_msgs/msg/People"}, "people_msgs is not installed: apt install"),
    ],
)
def test_a_parameter_that_makes_no_sense_ends_it(loopback, parameters, line):
    node = NodeProcess(loopback / f"refused{len(list(loopback.iterdir()))}.log", **parameters)
    assert node.process.wait(STARTS) == 1
    (said,) = [one for one in node.said().splitlines() if "[INFO]" not in one]
    assert line in said
