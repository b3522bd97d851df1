"""From messages to decisions, without ROS: when it drives, how, and every reason to stand."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
from torchrl_morl_ros.driver import Driver
from torchrl_morl_ros.settings import HUMAN_MESSAGES, Settings, descriptions

from tests import _any_robot as any_robot
from torchrl_morl.deploy import LidarGeometry, PolicyRunner, load_policy
from torchrl_morl.testing import untrained_policy

from ._messages import array, odometry, people, scan, stamped, transform

SHIPPED = Path(__file__).resolve().parents[2] / "recipes" / "policies"
POLICY = load_policy(SHIPPED / "polished_seed0")
NOBODY = {"human_message": "none"}
ARRAY, PEOPLE = HUMAN_MESSAGES[2:]


def driver(preference=(0.2, 0.5, 0.3), lookup=None, policy=POLICY, **settings) -> Driver:
    return Driver(policy, Settings(policy="somewhere", **settings), preference, lookup)


def told(made: Driver, stamp: float = 10.0, goal=(6.0, 1.0), human=(3.0, -1.0)) -> Driver:
    """All that it needs to drive."""
    made.inputs.take_odometry(odometry(stamp))
    made.inputs.take_scan(scan(stamp))
    if goal:
        made.inputs.take_goal(stamped(stamp, *goal))
    if human and made.settings.human_message == HUMAN_MESSAGES[1]:
        made.inputs.take_people(stamped(stamp, *human))
    return made


# --- how it drives


def test_it_drives_as_the_runner_of_the_library():
    """A robot at (1, 2) that looks north; goal and human in other frames than its own."""
    made = driver()
    ranges = np.linspace(0.5, 6.0, 541)
    fields = {"angle_min": -2.0, "angle_increment": 4.0 / 540, "range_min": 0.2, "range_max": 5.0}
    made.inputs.take_odometry(odometry(10.0, 1.0, 2.0, math.pi / 2))
    made.inputs.take_scan(scan(10.0, ranges, **fields))
    made.inputs.take_goal(stamped(10.0, 1.0, 7.0))
    made.inputs.take_people(stamped(10.0, 1.0, 2.0, frame="odom"))
    made.inputs.take_people(stamped(10.0, 2.0, 1.0, frame="base_link"))
    decision = made.step(10.1)

    lidar = LidarGeometry(-2.0, 4.0 / 540, 541, range_min=0.2, range_max=5.0)
    runner = PolicyRunner(POLICY, lidar=lidar)
    expected = runner.step(
        ranges,
        goal=(5.0, 0.0),
        human=(math.hypot(2, 1), math.atan2(1, 2)),
        preference=(0.2, 0.5, 0.3),
        stamp=10.0,
        time=10.1,
    )
    assert decision.reason == "drive"
    assert (decision.speed, decision.turn_rate) == pytest.approx(
        (expected.speed, expected.turn_rate), abs=1e-6
    )


def test_the_mount_turns_the_scan():
    ranges = np.full(360, math.inf)
    ranges[:60] = 0.6  # a wall somewhere
    straight = told(driver(**NOBODY))
    straight.inputs.take_scan(scan(10.0, ranges))
    turned = told(driver(**NOBODY, lidar_mount=(0.0, 0.0, -math.pi / 2)))
    turned.inputs.take_scan(scan(10.0, np.roll(ranges, 90)))
    one, other = straight.step(10.1), turned.step(10.1)
    assert dataclasses.astuple(one) == pytest.approx(dataclasses.astuple(other), abs=1e-6)


def test_a_lidar_upside_down_by_tf2():
    ranges = np.full(360, math.inf)
    ranges[200:230] = 0.6
    straight = told(driver(**NOBODY))
    straight.inputs.take_scan(scan(10.0, ranges, angle_min=-math.pi, angle_increment=math.pi / 180))
    # Rolled by half a turn, beams run clockwise: the same picture comes in the other order.
    made = driver(**NOBODY, lookup=lambda target, source: transform(0.0, 0.0, roll=math.pi))
    turned = told(made)
    mirrored = scan(10.0, ranges, frame="laser", angle_min=math.pi, angle_increment=-math.pi / 180)
    turned.inputs.take_scan(mirrored)
    one, other = straight.step(10.1), turned.step(10.1)
    assert (one.speed, one.turn_rate) == pytest.approx((other.speed, other.turn_rate), abs=1e-6)


def test_the_nearest_of_many_people_counts():
    made = told(driver(human_message=ARRAY))
    made.inputs.take_people(array(10.0, (5.0, 0.0), (1.5, 0.5), (-4.0, 0.0)))
    alone = told(driver(), human=(1.5, 0.5))
    assert made.step(10.1) == alone.step(10.1)


def test_an_empty_array_is_nobody_and_needs_no_other_word():
    made = told(driver(human_message=ARRAY))
    made.inputs.take_people(array(10.0))
    decision = made.step(10.1)
    assert decision.reason == "drive"
    assert decision == told(driver(**NOBODY)).step(10.1)


def test_velocities_of_a_tracker_reach_a_policy_that_reads_them(policy_folders):
    policy = load_policy(policy_folders["walking"])
    assert policy.sensing.observe_human_velocity
    decisions = []
    for velocity in ((0.0, 0.0), (-1.0, 0.5)):
        made = told(driver(policy=policy, human_message=PEOPLE, preference=()))
        made.inputs.take_odometry(odometry(10.0, 0.0, 0.0, math.pi / 2))
        made.inputs.take_people(people(10.0, (0.0, 2.0, *velocity)))
        decisions.append(made.step(10.1))
    lidar = LidarGeometry(-math.pi, math.pi / 180, 360, range_min=0.1, range_max=8.0)
    # East is to the right of a robot that looks north.
    expected = PolicyRunner(policy, lidar=lidar).step(
        np.full(360, math.inf),
        goal=(math.hypot(6, 1), math.atan2(1, 6) - math.pi / 2),
        human=(2.0, 0.0),
        human_velocity=(0.5, 1.0),
        preference=made.preference,
        stamp=10.0,
        time=10.1,
    )
    assert (decisions[1].speed, decisions[1].turn_rate) == pytest.approx(
        (expected.speed, expected.turn_rate), abs=1e-6
    )
    assert decisions[0] != decisions[1]


def test_without_velocities_they_come_from_two_positions(policy_folders):
    policy = load_policy(policy_folders["walking"])
    made = told(driver(policy=policy, preference=()), human=(3.0, -1.0))
    still = made.step(10.05)
    told(made, 10.2, human=(2.9, -1.0))  # 0.5 m/s towards the robot
    walks = made.step(10.25)
    assert still.reason == walks.reason == "drive"
    known = told(driver(policy=policy, human_message=PEOPLE, preference=()), 10.2)
    known.inputs.take_people(people(10.2, (2.9, -1.0, -0.5, 0.0)))
    assert dataclasses.astuple(walks)[:2] == pytest.approx(
        dataclasses.astuple(known.step(10.25))[:2], abs=1e-5
    )


def test_a_goal_before_the_robot_stays_where_it_was():
    made = told(driver(**NOBODY), goal=None)
    made.inputs.take_goal(stamped(10.0, 4.0, 0.0, frame="base_link"))
    made.inputs.take_odometry(odometry(10.1, 3.9, 0.0))
    assert made.step(10.1).reason == "goal reached"


def test_goals_in_a_map_follow_the_localisation():
    offset = [0.0]
    made = told(
        driver(**NOBODY, lookup=lambda target, source: transform(offset[0], 0.0)), goal=None
    )
    made.inputs.take_goal(stamped(10.0, 4.0, 0.0, frame="/map"))
    assert made.step(10.1).reason == "drive"
    offset[0] = -3.9
    assert made.step(10.15).reason == "goal reached"


def test_an_arrived_robot_waits_for_another_goal():
    made = told(driver(**NOBODY), goal=(0.2, 0.0))
    assert made.step(10.1).reason == "goal reached"
    made.inputs.take_odometry(odometry(10.1, -2.0, 0.0))  # somebody has pushed it away
    assert made.step(10.15).reason == "goal reached"
    made.inputs.take_goal(stamped(10.1, 4.0, 0.0))
    assert made.step(10.18).reason == "drive"


def test_limits_and_radius_are_those_of_the_settings():
    made = told(driver(**NOBODY, max_speed=0.1, goal_radius=1.0))
    assert 0 < made.step(10.1).speed <= 0.1
    made.inputs.take_goal(stamped(10.0, 0.9, 0.0))
    assert made.step(10.15).reason == "goal reached"


# --- why it stands

MISSING = {
    "scan": ("no scan", "nothing has come on topic 'scan'"),
    "odometry": ("no odometry", "nothing has come on topic 'odom'"),
    "people": ("human lost", "nothing has come on topic 'human': for nobody set human_message"),
    "goal": ("no goal", "no goal has come on topic 'goal_pose'"),
}


@pytest.mark.parametrize("missing", MISSING)
def test_what_has_never_come_is_named(missing):
    made = driver()
    for name, message in (
        ("odometry", odometry(10.0)),
        ("scan", scan(10.0)),
        ("people", stamped(10.0, 3.0, 0.0)),
        ("goal", stamped(10.0, 6.0, 0.0)),
    ):
        if name != missing:
            getattr(made.inputs, f"take_{name}")(message)
    reason, detail = MISSING[missing]
    decision = made.step(10.1)
    assert (decision.speed, decision.turn_rate, decision.reason) == (0.0, 0.0, reason)
    assert decision.detail.startswith(detail)


@pytest.mark.parametrize(
    ("late", "reason", "detail"),
    [
        ("scan", "stale", "scan is 0.25 s old, scan_timeout is 0.2 s"),
        ("odom", "stale", "odom is 0.25 s old, odom_timeout is 0.2 s"),
        ("human", "human lost", "human is 0.25 s old, human_timeout is 0.2 s"),
    ],
)
def test_what_is_too_old_is_named(late, reason, detail):
    made = told(driver(), 10.0)
    fresh = 10.15
    for name, take, message in (
        ("odom", made.inputs.take_odometry, odometry(fresh)),
        ("scan", made.inputs.take_scan, scan(fresh)),
        ("human", made.inputs.take_people, stamped(fresh, 3.0, 0.0)),
    ):
        if name != late:
            take(message)
    decision = made.step(10.25)
    assert (decision.speed, decision.reason, decision.detail) == (0.0, reason, detail)


def test_each_timeout_is_its_own():
    made = told(driver(human_timeout=1.0, scan_timeout=0.3))
    made.inputs.take_odometry(odometry(10.3))
    made.inputs.take_scan(scan(10.1))
    assert made.step(10.39).reason == "drive"
    assert made.step(10.41).detail == "scan is 0.31 s old, scan_timeout is 0.3 s"


def test_a_lost_human_may_be_nobody():
    made = told(driver(human_lost="nobody"), human=None)
    assert made.step(10.1) == told(driver(**NOBODY)).step(10.1)
    told(made, 10.2)
    assert made.step(10.2).reason == "drive"
    told(made, 10.5, human=None)
    assert made.step(10.55).reason == "drive"


BAD = {
    "scan of NaN": (lambda i: i.take_scan(scan(10.0, np.full(360, math.nan))), "no scan"),
    "scan of nothing": (lambda i: i.take_scan(scan(10.0, np.zeros(0))), "no scan"),
    "scan of zeros": (lambda i: i.take_scan(scan(10.0, np.zeros(360))), "no scan"),
    "scan without increment": (lambda i: i.take_scan(scan(10.0, angle_increment=0.0)), "refused"),
    "scan in degrees": (lambda i: i.take_scan(scan(10.0, angle_increment=1.0)), "refused"),
    "scan of four beams": (lambda i: i.take_scan(scan(10.0, np.ones(4))), "refused"),
    "odometry in a map": (lambda i: i.take_odometry(odometry(10.0, frame="map")), "refused"),
    "odometry of NaN": (lambda i: i.take_odometry(odometry(10.0, math.nan)), "refused"),
    "human in a map": (lambda i: i.take_people(stamped(10.0, 1, 1, frame="map")), "refused"),
    "human of NaN": (lambda i: i.take_people(stamped(10.0, math.nan, 1)), "refused"),
    "human in the robot": (lambda i: i.take_people(stamped(10.0, 0, 0)), "refused"),
    "goal in a map": (lambda i: i.take_goal(stamped(10.0, 1, 1, frame="map")), "refused"),
    "goal in no frame": (lambda i: i.take_goal(stamped(10.0, 1, 1, frame="")), "refused"),
    "human in no frame": (lambda i: i.take_people(stamped(10.0, 1, 1, frame="")), "refused"),
    "goal of infinity": (lambda i: i.take_goal(stamped(10.0, math.inf, 1)), "refused"),
    "goal before it, of NaN": (
        lambda i: i.take_goal(stamped(10.0, math.nan, 1, frame="base_link")),
        "refused",
    ),
}


@pytest.mark.parametrize("bad", BAD)
def test_what_makes_no_sense_stops_it_and_what_does_again_lets_it_drive(bad):
    give, reason = BAD[bad]
    made = told(driver())
    assert made.step(10.02).reason == "drive"
    give(made.inputs)
    decision = made.step(10.1)
    assert (decision.speed, decision.turn_rate, decision.reason) == (0.0, 0.0, reason)
    assert "\n" not in decision.detail
    assert decision.detail
    told(made, 10.15)
    assert made.step(10.2).reason == "drive"


def test_an_orientation_that_nobody_filled_in():
    made = told(driver(**NOBODY))
    message = odometry(10.0)
    message.pose.pose.orientation.w = 0.0
    made.inputs.take_odometry(message)
    assert made.step(10.1).detail == (
        "odometry: the orientation (0.0, 0.0, 0.0, 0.0) is no rotation: x, y, z, w must have length 1"
    )


def test_two_clocks():
    made = told(driver(**NOBODY), 1_790_000_000.0)
    decision = made.step(12.0)
    assert decision.reason == "clock"
    assert "s later than now: two clocks" in decision.detail
    assert "use_sim_time" in decision.detail


def test_stamps_of_a_simulation_on_the_clock_of_the_wall():
    made = told(driver(**NOBODY), 12.0)
    decision = made.step(1_790_000_000.0)
    assert decision.reason == "stale"
    assert "two clocks" in decision.detail
    assert "use_sim_time" in decision.detail


@pytest.mark.parametrize("late", ["scan", "odom", "human"])
def test_a_message_that_nobody_has_stamped(late):
    made = told(driver(), 1_790_000_000.0)
    give = {
        "scan": lambda: made.inputs.take_scan(scan(0.0)),
        "odom": lambda: made.inputs.take_odometry(odometry(0.0)),
        "human": lambda: made.inputs.take_people(stamped(0.0, 3.0, 0.0)),
    }
    give[late]()
    decision = made.step(1_790_000_000.1)
    assert decision.reason == ("human lost" if late == "human" else "stale")
    assert decision.detail == (
        f"{late} has no stamp: whoever publishes it must fill in header.stamp"
    )


def test_a_simulation_that_begins_anew():
    made = told(driver(**NOBODY), 500.0)
    assert made.step(500.1).reason == "drive"
    assert made.step(1.0).reason == "clock"
    told(made, 1.0)
    assert made.step(1.1).reason in ("drive", "clock")
    assert made.step(1.15).reason == "drive"


# --- between two steps


def test_between_steps_a_decision_holds_and_old_inputs_end_it():
    made = told(driver(**NOBODY))
    decision = made.step(10.05)
    assert made.watch(10.1) is decision
    assert made.watch(10.2) is decision
    assert made.watch(10.21).reason == "stale"
    told(made, 10.21)
    # It never makes a robot drive: that is for the next step.
    assert made.watch(10.22).reason == "stale"
    assert made.step(10.25).reason == "drive"


def test_a_scan_of_nan_ends_it_at_once():
    made = told(driver(**NOBODY))
    assert made.step(10.05).reason == "drive"
    made.inputs.take_scan(scan(10.06, np.full(360, math.nan)))
    assert made.watch(10.06).reason == "no scan"


# --- preferences and policies


def test_without_a_preference_all_weigh_the_same():
    assert driver(preference=()).preference == pytest.approx((1 / 3, 1 / 3, 1 / 3))


@pytest.mark.parametrize(
    "wrong", [(0.5, 0.5), (0.5, 0.6, 0.0), (-0.1, 0.6, 0.5), (math.nan, 0.5, 0.5), (math.inf, 0, 0)]
)
def test_a_preference_off_the_simplex_is_named(wrong):
    with pytest.raises(
        ValueError, match=r"^preference must be 3 weights .* for demo, distance, eff"
    ):
        driver(preference=wrong)


def test_a_policy_that_does_not_tell_what_it_senses():
    policy = dataclasses.replace(untrained_policy(), sensing=None)
    with pytest.raises(ValueError, match="policy: somewhere does not tell what it senses"):
        driver(policy=policy)


# --- a policy that reads which robot it drives


@pytest.fixture(scope="module")
def of_any_robot(tmp_path_factory):
    return load_policy(any_robot.save(tmp_path_factory.mktemp("policies") / "any"))


@pytest.mark.parametrize("somebody", [True, False])
def test_it_is_told_the_robot_and_drives_as_the_runner_of_the_library(of_any_robot, somebody):
    given = {} if somebody else NOBODY
    robot = any_robot.ROBOT[:3]
    made = told(driver(policy=of_any_robot, robot=robot, **given))
    decision = made.step(10.1)
    lidar = LidarGeometry(-math.pi, math.pi / 180, 360, range_min=0.1, range_max=8.0)
    expected = PolicyRunner(of_any_robot, lidar=lidar, robot=robot).step(
        np.full(360, math.inf),
        goal=(math.hypot(6, 1), math.atan2(1, 6)),
        human=(math.hypot(3, 1), math.atan2(-1, 3)) if somebody else None,
        human_velocity=(0.0, 0.0) if somebody else None,
        preference=(0.2, 0.5, 0.3),
        stamp=10.0,
        time=10.1,
    )
    assert decision.reason == "drive"
    assert (decision.speed, decision.turn_rate) == pytest.approx(
        (expected.speed, expected.turn_rate), abs=1e-5
    )


def test_a_robot_that_is_missing_or_is_not_read_is_named(of_any_robot):
    with pytest.raises(
        ValueError, match=r"^robot must be radius \(m\), top speed .* got \[0.0, 0"
    ) as one:
        driver(policy=of_any_robot)
    with pytest.raises(ValueError, match=r"^robot must be left out: this policy does not") as other:
        driver(robot=any_robot.ROBOT)
    assert all("\n" not in str(error.value) for error in (one, other))


# --- settings


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("base_frame_id", ""),
        ("human_message", "people"),
        ("human_lost", "drive"),
        ("scan_timeout", -1.0),
        ("human_timeout", math.nan),
        ("clock_timeout", 0.0),
        ("goal_radius", math.inf),
        ("max_speed", -0.1),
        ("lidar_mount", (0.0, 0.0)),
        ("lidar_mount", (0.0, 0.0, math.nan)),
        ("robot", (0.2, 0.5)),
        ("robot", (0.0, *any_robot.ROBOT[1:])),
        ("robot", (*any_robot.ROBOT[:5], math.nan)),
        ("publish_rate", 1.0),
    ],
)
def test_a_setting_that_makes_no_sense_is_named(name, value):
    with pytest.raises(ValueError, match=rf"^{name} must be .*, got ") as error:
        Settings(**{name: value})
    assert "\n" not in str(error.value)


def test_every_setting_is_described():
    assert all(len(description) > 20 for _, description in descriptions().values())
