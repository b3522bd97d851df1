"""Whether a robot can drive a recording, and what is said if it cannot."""

from __future__ import annotations

import dataclasses
import math
import re

import numpy as np
import pytest

from envs import HUMAN_RADIUS, TURTLEBOT2
from envs.demonstrations.feasibility import Tolerances, check
from envs.demonstrations.recordings import Recording
from tests._recordings import line


def bump(recording: Recording, field: str, index: int, value: float, column=()) -> Recording:
    getattr(recording, field)[(index, *column)] = value
    return recording


def corner() -> Recording:
    """A drive without slip that turns by 1.2 rad in one step."""
    heading = np.where(np.arange(60) < 30, 0.0, 1.2)
    middle = (heading[1:] + heading[:-1]) / 2
    way = 0.08 * np.stack((np.cos(middle), np.sin(middle)), axis=-1).cumsum(0)
    position = np.concatenate((np.zeros((1, 2)), way))
    return line(position=position, heading=heading, goal=np.tile(position[-1], (60, 1)))


REASONS = {
    "too fast": (line(0.6), "drives at 0.60 m/s at .* s, over 0.50 + 0.05 m/s in .* step"),
    "backwards": (
        line(heading=np.full(60, math.pi)),
        "drives backwards at 0.40 m/s at .* s, over 0.00 + 0.05 m/s in .* step",
    ),
    "turns too fast": (
        corner(),
        "turns at 6.00 rad/s at 5.80 s, over 3.14 + 0.20 rad/s in 1 step",
    ),
    "slips": (
        line(heading=np.full(60, 0.6)),
        "slips sideways at 0.23 m/s at .* s, over 0.00 + 0.1",
    ),
    "gap": (
        line(time=np.delete(np.arange(0, 12, 0.2), [20, 21, 22])),
        "time jumps by 0.80 s at point 20, over 0.5 s",
    ),
    "time goes back": (
        bump(line(), "time", 7, 1.15),
        "time goes back from 1.2 to 1.15 s at point 7",
    ),
    "time stands": (bump(line(), "time", 7, 1.2), "time stands still at point 7, 1.2 s"),
    "not finite": (
        bump(line(), "position", 3, math.inf, (1,)),
        "column y is not finite at point 3",
    ),
    "no heading at one point": (
        bump(line(), "heading", 9, math.nan),
        "column heading is not finite at point 9",
    ),
    "one point": (line(time=np.zeros(1)), "has 1 point(s), fewer than 2"),
    "no point": (line(time=np.zeros(0)), "has 0 point(s), fewer than 2"),
    "too short": (line(time=np.array([0.0, 0.1])), "is shorter than a control step of 0.2 s"),
    "never there": (
        line(time=np.arange(0, 8, 0.2)),
        "never comes within 0.3 m of the goal, 0.88 m at best",
    ),
    "there already": (
        line(goal=np.tile([0.1, 0.0], (60, 1))),
        "starts within 0.3 m of the goal",
    ),
    "wandering goal": (
        bump(line(), "goal", 5, 0.5, (1,)),
        "the goal moves by 0.50 m, most at point 5: a trajectory has one goal",
    ),
    "human": (line(human=np.tile([2.0, 0.42], (60, 1))), "touches the human at 5.00 s"),
    "box": (line(boxes=np.array([[2.0, 0.5, 0.0, 0.3, 0.33]])), "touches a box at 4.20 s"),
    "too long": (
        line(0.05, np.arange(0, 80, 0.2)),
        "takes 370 control steps, an episode has 300",
    ),
    "stands without heading": (
        line(0.0, heading=None),
        "has no heading and never moves, so that none can be derived",
    ),
}


@pytest.mark.parametrize("name", REASONS)
def test_a_rejection_says_why(name):
    recording, expected = REASONS[name]
    path, reasons = check(recording)
    assert path is None
    pattern = re.escape(expected).replace(r"\.\*", ".*")
    assert len(reasons) == 1
    assert re.match(pattern, str(reasons[0])), reasons


def test_the_drive_that_all_of_them_spoil_is_accepted():
    path, reasons = check(line())
    assert reasons == []
    assert path.pose.shape == (48, 3)


def test_all_reasons_are_given():
    human = np.tile([2.0, 0.0], (60, 1))
    _, reasons = check(line(0.7, human=human, goal=np.tile([4.0, 3.0], (60, 1))))
    assert [str(reason).split()[0] for reason in reasons] == ["never", "drives", "touches"]


def test_contact_is_that_of_the_environment():
    touching = TURTLEBOT2.radius + HUMAN_RADIUS
    for gap, accepted in ((-1e-6, False), (1e-6, True)):
        human = np.tile([2.0, touching + gap], (60, 1))
        assert (check(line(human=human))[0] is not None) is accepted


def test_what_comes_after_the_goal_does_not_count():
    recording = line()
    recording.position[55:, 1] = 3.0  # a jump after the goal was reached at step 47
    assert check(recording)[1] == []


@pytest.mark.parametrize(
    ("name", "tolerances"),
    [
        ("too fast", {"speed": 0.11}),
        ("backwards", {"backwards": 0.41}),
        ("turns too fast", {"turn_rate": 2.9}),
        ("slips", {"slip": 0.24}),
        ("gap", {"gap": 0.81}),
    ],
)
def test_each_tolerance_counts(name, tolerances):
    recording, _ = REASONS[name]
    assert check(recording)[0] is None
    assert check(recording, tolerances=Tolerances(**tolerances))[1] == []


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("slip", -0.1, "The slip tolerance must be finite and not negative: -0.1"),
        ("speed", math.nan, "The speed tolerance must be finite and not negative: nan"),
        ("turn_rate", math.inf, "The turn_rate tolerance must be finite"),
        ("gap", 0.0, "The gap tolerance must be positive"),
    ],
)
def test_tolerances_are_checked(name, value, message):
    with pytest.raises(ValueError, match=message):
        Tolerances(**{name: value})


@pytest.mark.parametrize(
    "argument",
    [
        {"goal_radius": 0.0},
        {"goal_radius": -1.0},
        {"goal_radius": math.nan},
        {"goal_radius": math.inf},
        {"max_steps": 0},
        {"max_steps": 1.5},
    ],
)
def test_limits_are_checked(argument):
    ((name, value),) = argument.items()
    with pytest.raises(ValueError, match=f"{name} must be .*: {value}"):
        check(line(), **argument)


# --- hints ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "tolerance"),
    [
        ("too fast", "speed"),
        ("backwards", "backwards"),
        ("turns too fast", "turn_rate"),
        ("slips", "slip"),
        ("gap", "gap"),
    ],
)
def test_the_tolerance_that_is_proposed_is_enough(name, tolerance):
    recording, _ = REASONS[name]
    (reason,) = check(recording)[1]
    proposed = re.search(rf"--{tolerance.replace('_', '-')}-tolerance (\S+)", reason.hint)[1]
    assert check(recording, tolerances=Tolerances(**{tolerance: float(proposed)}))[1] == []


def test_the_steps_and_the_goal_radius_that_are_proposed_are_enough():
    (reason,) = check(REASONS["too long"][0])[1]
    assert reason.hint == "--max-steps 370"
    assert check(REASONS["too long"][0], max_steps=370)[1] == []
    (reason,) = check(REASONS["never there"][0])[1]
    assert reason.hint == "--goal-radius 0.88"
    assert check(REASONS["never there"][0], goal_radius=0.88)[1] == []


def curve(**changes) -> Recording:
    """A drive on a circle of 4 m, a third of a turn to the left."""
    time = np.arange(0.0, 21.0, 0.1)
    angle = 0.1 * time
    position = 4 * np.stack((np.sin(angle), 1 - np.cos(angle)), axis=-1)
    values = {"position": position, "heading": angle, "goal": np.tile(position[-1], (210, 1))}
    return line(0.4, time, human=np.tile([-2.0, -2.0], (210, 1)), **(values | changes))


FRAMES = {
    "degrees": lambda h: np.rad2deg(h),
    "clockwise": lambda h: -h,
    "degrees clockwise": lambda h: np.rad2deg(-h),
    "clockwise from the y axis, or with x and y swapped": lambda h: np.pi / 2 - h,
    "degrees clockwise from the y axis, or with x and y swapped": lambda h: 90 - np.rad2deg(h),
    "counter-clockwise from the y axis": lambda h: h - np.pi / 2,
}


@pytest.mark.parametrize("name", FRAMES)
def test_a_heading_of_another_convention_is_named(name):
    assert check(curve())[1] == []
    (reason,) = check(curve(heading=FRAMES[name](curve().heading)))[1]
    assert re.fullmatch(
        rf"\S+ in heading at point \d+: {name}\? radians, counter-clockwise from the x axis, are expected",
        str(reason),
    )


def test_x_and_y_swapped_are_named():
    recording = curve()
    swapped = curve(position=recording.position[:, ::-1], goal=recording.goal[:, ::-1])
    (reason,) = check(swapped)[1]
    assert "x and y swapped?" in str(reason)


def test_a_heading_of_no_convention_gets_its_own_reasons():
    rng = np.random.default_rng(0)
    reasons = check(curve(heading=rng.uniform(-3, 3, 210)))[1]
    assert {str(reason).split()[0] for reason in reasons} == {"drives", "turns", "slips"}


@pytest.mark.parametrize(
    ("unit", "factor"), [("milliseconds", 1e3), ("microseconds", 1e6), ("nanoseconds", 1e9)]
)
@pytest.mark.parametrize("epoch", [0.0, 1.7e9])
def test_a_unit_of_time_is_named(unit, factor, epoch):
    recording = line()
    (reason,) = check(dataclasses.replace(recording, time=(recording.time + epoch) * factor))[1]
    assert str(reason).endswith(f"{unit}? seconds are expected")


def test_a_pause_is_no_other_unit():
    time = np.append(np.arange(0.0, 6.0, 0.2), np.arange(4000.0, 4006.0, 0.2))
    x = 0.4 * np.append(np.arange(0.0, 6.0, 0.2), np.arange(6.0, 12.0, 0.2))
    (reason,) = check(line(time=time, position=np.stack((x, 0 * x), axis=-1)))[1]
    assert "expected" not in str(reason)
    assert reason.hint.startswith("--gap-tolerance 3994")


def test_an_epoch_in_float32_is_named():
    time = (1.7e9 + np.arange(0.0, 12.0, 0.2)).astype(np.float32).astype(float)
    (reason,) = check(line(position=line().position, time=time))[1]
    assert str(reason) == "time stands still at point 1, 1700000000 s"
    assert "float32" in reason.hint


def test_an_epoch_in_float64_is_fine():
    recording = line()
    assert check(line(position=recording.position, time=recording.time + 1.7e9))[1] == []


def test_millimetres_are_named():
    recording = line()
    reasons = check(
        line(
            position=1000 * recording.position,
            goal=1000 * recording.goal,
            human=1000 * recording.human,
        )
    )[1]
    assert "positions in metres, times in seconds?" in [reason.hint for reason in reasons]
