"""Where points are, and what is said of frames that nobody knows."""

from __future__ import annotations

import math

import pytest
from torchrl_morl_ros.frames import Frames
from torchrl_morl_ros.geometry import Pose

from ._messages import point, transform


def frames(lookup=None) -> Frames:
    made = Frames("base_link", "odom", lookup)
    made.add(10.0, Pose(0.0, 0.0, 3.0))
    made.add(10.2, Pose(1.0, 2.0, -3.0))
    return made


def test_between_two_odometries_it_turns_the_short_way():
    x, y, yaw = frames().robot_at(10.1)
    assert (x, y) == pytest.approx((0.5, 1.0))
    assert yaw == pytest.approx(math.pi)


def test_outside_of_its_memory_the_nearest_end_counts():
    made = frames()
    assert made.robot_at(1.0) == (0.0, 0.0, 3.0)
    assert made.robot_at(99.0) == (1.0, 2.0, -3.0)
    made.add(13.0, Pose(5.0, 5.0, 0.0))
    assert made.robot_at(1.0) == (5.0, 5.0, 0.0)  # two seconds are remembered


def test_no_stamp_is_now():
    assert frames().robot_at(0.0) == (1.0, 2.0, -3.0)


def test_time_that_goes_back_begins_anew():
    made = frames()
    made.add(1.0, Pose(7.0, 0.0, 0.0))
    assert made.robot_at(10.1) == (7.0, 0.0, 0.0)


def test_a_point_before_the_robot_is_where_the_robot_was_then():
    made = Frames("base_link", "odom")
    made.add(10.0, Pose(0.0, 0.0, 0.0))
    made.add(10.2, Pose(1.0, 0.0, math.pi / 2))
    assert made.fixed(point(2.0, 0.0), "base_link", 10.0) == pytest.approx((2.0, 0.0))
    assert made.fixed(point(2.0, 0.0), "base_link", 10.2) == pytest.approx((1.0, 2.0))
    assert made.fixed(point(2.0, 0.0), "odom", 10.2) == (2.0, 0.0)


def test_other_frames_are_asked_for():
    asked = []

    def lookup(target, source):
        asked.append((target, source))
        return transform(1.0, 0.0, math.pi / 2)

    assert frames(lookup).fixed(point(2.0, 0.0), "map", 10.0) == pytest.approx((1.0, 2.0))
    assert asked == [("odom", "map")]


def test_without_tf2_other_frames_are_named():
    with pytest.raises(LookupError, match=r"it is in frame 'map', and without tf2 only 'odom' and"):
        frames().fixed(point(2.0, 0.0), "map", 10.0)


def test_a_message_that_names_no_frame():
    for lookup in (None, lambda target, source: transform(0.0, 0.0)):
        with pytest.raises(LookupError, match=r"^it names no frame: fill in header.frame_id$"):
            frames(lookup).fixed(point(2.0, 0.0), "", 10.0)


def test_before_the_first_odometry():
    with pytest.raises(LookupError, match="there is no odometry yet"):
        Frames("base_link", "odom").fixed(point(2.0, 0.0), "base_link", 10.0)


def test_a_point_that_is_none():
    with pytest.raises(ValueError, match="its position is not finite"):
        frames().fixed(point(math.nan, 0.0), "odom", 10.0)
