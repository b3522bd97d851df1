"""Every way in which the robot stops, and how long after it stands.

The robot's clock runs at a quarter of the wall's, so that a machine that is busy with other tests does not
stop the robot by itself: delays are those of a machine that is four times as fast. ``ROS_FACTOR=1`` measures in
real time, without ``/clock``. Both are in ``docs/how_to/ros.md``.
"""

from __future__ import annotations

import os
import statistics

import pytest

from ._robot import STARTS, NodeProcess, Robot
from .conftest import TABLE

PERIOD, ROUNDING = 0.2, 1e-6
TIMES = 3
FACTOR = float(os.environ.get("ROS_FACTOR", "0.25"))
PARAMETERS = {"use_sim_time": "false" if FACTOR == 1.0 else "true", "clock_timeout": "10.0"}


@pytest.fixture(scope="module")
def node(loopback):
    node = NodeProcess(loopback / "node.log", **PARAMETERS)
    yield node
    node.end()


@pytest.fixture(scope="module")
def robot(loopback):
    robot = Robot(seed=7, factor=FACTOR)
    yield robot
    robot.close()


def drives(robot: Robot, limit: float = STARTS) -> None:
    """Let it drive at full speed towards its goal, from wherever it is."""
    if robot.ended or robot.pose[0] > 4.0:
        robot.begin()
    robot.fault, robot.began = "", None
    assert robot.run(lambda: robot.reason != "", limit), "the node tells nothing"
    robot.rest(0.5)  # of the old scene nothing is left
    robot.send_goal()
    assert robot.run(lambda: robot.reason == "drive" and robot.velocity[0] > 0.2, limit), robot.told
    robot.rest(0.5)


def measure(robot: Robot, begin: float) -> tuple[float, float]:
    """From the fault to a zero velocity being sent, and to standing."""

    def zeros() -> list[float]:
        return [t for t, speed, turn in robot.commands if t >= begin and speed == turn == 0.0]

    # On a busy machine the base may have stopped by itself before.
    assert robot.run(zeros, 5.0 / FACTOR)
    return zeros()[0] - begin, standing(robot, begin)


def standing(robot: Robot, begin: float) -> float:
    """From the fault to standing."""

    def still() -> list[float]:
        return [m.time for m in robot.moments if m.time > begin and m.stands]

    assert robot.run(still, 5.0 / FACTOR)
    # It has stood for the whole of the step at whose end that is seen.
    return still()[0] - robot.period - begin


FAULTS = {
    # What is wrong, the reason that is told, and when it can be known: at once with the first message
    # that is wrong, or one period after the last one that is right.
    "silent": ("the scan falls silent", "stale", PERIOD),
    "stale": ("scans with an old stamp", "stale", PERIOD),
    "nan": ("a scan of NaN", "no scan", 0.0),
    "lost": ("the human is lost", "human lost", PERIOD),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_it_stands_within_a_period_of_what_can_be_known(node, robot, fault):
    name, reason, known = FAULTS[fault]
    sent, stood = [], []
    for _ in range(TIMES):
        drives(robot)
        last_right = robot.moments[-1].time
        robot.fault = fault
        assert robot.run(lambda: robot.began is not None, 5.0 / FACTOR)
        zero, stands = measure(robot, last_right if known else robot.began)
        sent.append(zero)
        stood.append(stands)
        assert robot.run(lambda: robot.reason == reason, 5.0 / FACTOR), robot.told[-1]
        robot.fault = ""
        # It goes on by itself.
        assert robot.run(lambda: robot.reason == "drive", 5.0 / FACTOR)
    report(name, known, sent, stood)
    assert statistics.median(sent) <= known + PERIOD + ROUNDING
    assert statistics.median(stood) <= known + PERIOD + ROUNDING


def test_killed_and_started_anew(robot, node):
    # Nobody tells the base: it knows when commands have stayed away for that long.
    known, stood = robot.get_parameter("cmd_vel_timeout").value, []
    for _ in range(TIMES):
        drives(robot)
        begin = robot.now
        node.kill()
        stood.append(standing(robot, begin))
        robot.told.clear()
        node.start()
        # Whoever comes back knows of no goal and waits for one.
        assert robot.run(lambda: robot.reason == "no goal", STARTS), robot.told
        robot.rest(1.0)
        assert robot.stands
        assert robot.reason == "no goal"
    report("the node is killed", known, [], stood)
    assert statistics.median(stood) <= known + PERIOD + ROUNDING
    drives(robot)  # and then it drives


def test_the_last_thing_that_an_interrupted_node_says_is_zero(robot, node):
    drives(robot)
    begin = robot.now
    node.interrupt()
    zero, stands = measure(robot, begin)
    report("the node is interrupted", 0.0, [zero], [stands])
    assert zero <= PERIOD
    assert node.end() == 0
    assert robot.commands[-1][1:] == (0.0, 0.0)


def report(name: str, known: float, sent: list[float], stood: list[float]) -> None:
    def shown(values: list[float]) -> str:
        if not values:
            return f"{'-':>13}"
        return f"{statistics.median(values):5.3f} ({max(values):5.3f})"

    if not TABLE:
        TABLE.append((f"{'median (most)':26}", "known after", "zero velocity", "stands"))
    TABLE.append((f"{name:26}", f"{known:11.2f}", shown(sent), shown(stood)))
