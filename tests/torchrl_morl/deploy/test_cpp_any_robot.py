"""The C++ header with a policy that reads which robot it drives: commands, marks, limits and what it refuses."""

from __future__ import annotations

import dataclasses
import json
import math
import re
import subprocess
from pathlib import Path

import numpy as np
import pytest

from benchmarks.cpp_library import CppRunner, build, compiler
from tests import _any_robot as any_robot
from torchrl_morl.deploy import PolicyRunner, load_policy

from ._alike import LIMITS, check_command, check_velocities, drive
from ._stops import LIDAR as CENTRED
from ._stops import step
from .test_cpp import LIDARS, POLISHED

pytestmark = pytest.mark.skipif(
    compiler() is None, reason="there is no C++ compiler: install g++ or clang++"
)

ROBOTS = {
    "ahead": any_robot.ROBOT,
    "behind": (0.35, 1.0, 3.1, 3.2, 3.0, -0.15),
    "a small one": (0.12, 0.25, 0.8, 6.28, 100.0, 0.0),
}


def carried_by(robot, lidar):
    """The lidar where the robot says, which sees as far as the robot says."""
    mount = (robot[5], *lidar.mount[1:])
    return dataclasses.replace(lidar, mount=mount, range_max=max(robot[4], lidar.range_max))


LIDAR = carried_by(any_robot.ROBOT, CENTRED)


@pytest.fixture(scope="module")
def of_any_robot(tmp_path_factory) -> Path:
    return any_robot.save(tmp_path_factory.mktemp("policies") / "any")


@pytest.mark.parametrize("lidar", LIDARS.values(), ids=LIDARS)
@pytest.mark.parametrize("robot", ROBOTS.values(), ids=ROBOTS)
def test_its_commands_are_those_of_the_runner_for_any_robot(
    cpp_library, of_any_robot, robot, lidar
):
    lidar = carried_by(robot, lidar)
    robot = (*robot[:3], min(robot[3], abs(lidar.increment) * lidar.num_beams), *robot[4:])
    ours = PolicyRunner(load_policy(of_any_robot), lidar=lidar, robot=robot)
    other = CppRunner(cpp_library, of_any_robot, lidar=lidar, robot=robot)
    commands = drive(ours, other, lidar, 100)
    speeds, turn_rates = np.array([(command.speed, command.turn_rate) for command in commands]).T
    assert speeds.min() >= 0 and speeds.max() <= robot[1]
    assert abs(turn_rates).max() <= robot[2]
    assert np.ptp(turn_rates) > 0.2


def test_every_number_of_the_robot_matters(cpp_library, of_any_robot):
    def command(robot):
        lidar = carried_by(robot, CENTRED)
        other = CppRunner(cpp_library, of_any_robot, lidar=lidar, robot=robot)
        found = step(other, human_velocity=(0.3, 0.2))
        return found.speed, found.turn_rate

    usual = command(any_robot.ROBOT)
    for entry in range(6):
        robot = list(any_robot.ROBOT)
        robot[entry] *= 0.4
        assert command(robot) != usual, entry
    # A lidar that sees further than scans are cut off at reads as one that sees as far.
    assert command((*any_robot.ROBOT[:4], 100.0, any_robot.ROBOT[5])) == usual


@pytest.mark.parametrize("lidar", LIDARS.values(), ids=LIDARS)
def test_three_numbers_and_what_the_lidar_says(cpp_library, of_any_robot, lidar):
    base = any_robot.ROBOT[:3]
    view = min(abs(lidar.increment) * lidar.num_beams, 2 * math.pi)
    whole = (*base, view, lidar.range_max, lidar.mount[0])
    for robot in (base, whole):
        ours = PolicyRunner(load_policy(of_any_robot), lidar=lidar, robot=base)
        assert ours.robot == pytest.approx(whole)
        drive(ours, CppRunner(cpp_library, of_any_robot, lidar=lidar, robot=robot), lidar, 20)


@pytest.mark.parametrize(
    ("entry", "value", "ours", "theirs"),
    [
        (
            3,
            4.4,
            "the view of the lidar is 4.4 rad, but 4.189 rad of lidar=",
            "view of the lidar is 4.4",
        ),
        (4, 9.0, "the range of the lidar is 9 m, but range_max=8 of lidar=", "range_max is 8"),
        (
            5,
            0.0,
            "the place ahead of the lidar is 0 m, but mount x=0.1 of lidar=",
            "its mount is at 0.1",
        ),
    ],
)
def test_a_robot_that_contradicts_its_lidar(cpp_library, of_any_robot, entry, value, ours, theirs):
    lidar = dataclasses.replace(any_robot.LIDAR, num_beams=120)
    robot = [*any_robot.ROBOT[:3], 4.19, 8.0, 0.1]
    PolicyRunner(load_policy(of_any_robot), lidar=lidar, robot=robot)
    CppRunner(cpp_library, of_any_robot, lidar=lidar, robot=robot)
    robot[entry] = value
    with pytest.raises(ValueError, match=re.escape(ours)) as caught:
        PolicyRunner(load_policy(of_any_robot), lidar=lidar, robot=robot)
    assert "\n" not in str(caught.value)
    with pytest.raises(ValueError, match=re.escape(theirs)):
        CppRunner(cpp_library, of_any_robot, lidar=lidar, robot=robot)


def test_nobody_is_marked_where_nobody_is_reported(cpp_library, of_any_robot):
    given = {"lidar": LIDAR, "robot": any_robot.ROBOT}
    ours = PolicyRunner(load_policy(of_any_robot), **given)
    other = CppRunner(cpp_library, of_any_robot, **given)
    people = (None, any_robot.SENSING.nobody, (3.999, math.pi), (4.0, 3.1416))
    found = []
    for time, human in enumerate(people, 10):
        expected, command = (
            step(runner, time, human=human, human_velocity=(0.0, 0.0)) for runner in (ours, other)
        )
        check_command(command, expected)
        found.append(command.turn_rate)
    assert found[0] == found[1]
    assert min(abs(found[0] - found[2]), abs(found[0] - found[3])) > 0.01


def test_limits_of_ones_own_and_velocities_for_any_robot(cpp_library, of_any_robot):
    given = {"lidar": LIDAR, "robot": any_robot.ROBOT}
    for limits in LIMITS[:2]:
        ours = PolicyRunner(load_policy(of_any_robot), **given, **limits)
        for time, velocity in ((10.0, (0.3, 0.2)), (10.8, (1.0, -1.0))):
            expected, found = (
                step(runner, time, human_velocity=velocity)
                for runner in (ours, CppRunner(cpp_library, of_any_robot, **given, **limits))
            )
            check_command(found, expected)
    ours = PolicyRunner(load_policy(of_any_robot), **given)
    check_velocities(ours, CppRunner(cpp_library, of_any_robot, **given))


def test_how_the_robot_moves(cpp_library, tmp_path):
    """Measured, commanded, over the seam of the circle, with the same inputs again, and after a pause."""
    folder = any_robot.save(tmp_path / "any", motion=True)
    given = {"lidar": LIDAR, "robot": any_robot.ROBOT}
    ours = PolicyRunner(load_policy(folder), **given)
    other = CppRunner(cpp_library, folder, **given)
    draw = np.random.default_rng(0)
    pose, commands = np.array([0.3, -0.2, 3.0]), []
    for stamp in (0.0, 0.2, 0.4, 0.6, 0.6, 0.8, 1.0, 2.5, 2.7, 2.9):
        x, y, heading = pose = pose + draw.normal(0.05, 0.05, 3)
        told = {
            "stamp": 10 + stamp,
            "odometry": (x, y, math.remainder(heading, 2 * math.pi)),
            "human_velocity": (0.2, 0.1),
        }
        time = 10 + 0.01 * len(commands) + stamp
        expected, found = (step(runner, time, **told) for runner in (ours, other))
        assert expected.reason == "drive", expected.detail
        check_command(found, expected)
        commands.append((found.speed, found.turn_rate))
    # After the pause it knows as little as at the start.
    assert commands[7] == commands[0] and len(set(commands)) == len(commands) - 1
    missing = step(other, 20.0, human_velocity=(0.2, 0.1))
    assert missing.reason == "refused"
    assert missing.detail == "this policy reads how the robot moves: give odometry"
    wrong = step(other, 20.2, human_velocity=(0.2, 0.1), odometry=(0.0, math.nan, 0.0))
    assert (wrong.reason, wrong.detail) == ("refused", "odometry must be finite")


def test_odometry_that_jumps_is_no_motion(cpp_library, tmp_path):
    folder = any_robot.save(tmp_path / "any", motion=True)
    given = {"lidar": LIDAR, "robot": any_robot.ROBOT}
    ours = PolicyRunner(load_policy(folder), **given)
    other = CppRunner(cpp_library, folder, **given)
    # 2 x 0.7 m/s x 0.2 s + 0.1 m are 0.38 m.
    places = (0.0, 0.1, 0.2, 0.57, 0.67, 1.06, 1.2, 1e30, 5.0)
    headings = (0.0, 0.1, 0.2, 0.3, 1.2, 1.3, 2.4, 2.5, 2.6)
    commands = []
    for number, (x, heading) in enumerate(zip(places, headings, strict=True)):
        told = {"stamp": 0.2 * number, "odometry": (x, 0.0, heading)}
        expected, found = (step(runner, 0.2 * number + 0.01, **told) for runner in (ours, other))
        assert expected.reason == "drive", expected.detail
        check_command(found, expected)
        commands.append((found.speed, found.turn_rate))
    assert len(set(commands)) == len(commands)


@pytest.mark.parametrize(
    ("folder", "robot", "message"),
    [
        (
            "any",
            None,
            "this policy reads which robot it drives (sensing.observe_robot): give robot,",
        ),
        ("any", (0.0, *any_robot.ROBOT[1:]), "above 0, got 0, 0.7, 2, 4.7, 8, 0.1"),
        ("any", (*any_robot.ROBOT[:4], 1e-4, 0.0), "above 0, got 0.25, 0.7, 2, 4.7, 0.0001, 0"),
        ("any", (math.nan, *any_robot.ROBOT[1:]), "robot must be finite, got nan, 0.7"),
        (
            "any",
            (*any_robot.ROBOT[:5], math.inf),
            "robot must be finite, got 0.25, 0.7, 2, 4.7, 8, inf",
        ),
        (
            "polished_seed0",
            any_robot.ROBOT,
            "this policy does not read robot, sensing.observe_robot is",
        ),
        *(("any", *one) for one in any_robot.TOO_MUCH),
    ],
)
def test_robots_that_are_refused(cpp_library, of_any_robot, folder, robot, message):
    folder = of_any_robot if folder == "any" else POLISHED
    with pytest.raises(ValueError, match=re.escape(message)) as found:
        CppRunner(cpp_library, folder, lidar=LIDAR, robot=robot)
    assert len(str(found.value).splitlines()) == 1


def test_a_mark_for_a_human_who_is_not_observed_is_refused(cpp_library, tmp_path):
    folder = any_robot.save(tmp_path / "any")
    file = folder / "policy.json"
    config = json.loads(file.read_text())
    config["sensing"]["observe_human"] = False
    file.write_text(json.dumps(config))
    with pytest.raises(ValueError, match="observe_nobody must be false where observe_human is"):
        CppRunner(cpp_library, folder, lidar=LIDAR, robot=any_robot.ROBOT)


def test_the_example_drives_a_turtlebot(of_any_robot, tmp_path):
    program = build("drive.cpp", tmp_path / "drive")
    run = subprocess.run(
        [str(program), str(of_any_robot), "0.2", "0.5", "0.3"],
        capture_output=True,
        text=True,
        timeout=60,
    )
    lines = run.stdout.splitlines()
    assert not run.stderr and len(lines) > 10
    assert all("drive" in line for line in lines[:-1])
    assert "refused" not in lines[-1]
