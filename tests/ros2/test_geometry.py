"""Poses and transforms against numbers worked out by hand."""

from __future__ import annotations

import math

import pytest
from torchrl_morl_ros.geometry import Pose, mounted, rotate, transformed, yaw

from ._messages import Fields, point, transform, turn

QUARTER = math.pi / 2


def test_a_point_ahead_of_a_robot_that_looks_north():
    robot = Pose(1.0, 2.0, QUARTER)
    assert robot.apply((3.0, 1.0)) == pytest.approx((0.0, 5.0))
    assert robot.polar((0.0, 5.0)) == pytest.approx((math.hypot(3, 1), math.atan2(1, 3)))


@pytest.mark.parametrize("heading", [0.0, 3.0, -3.0, 40.0])
def test_polar_undoes_apply(heading):
    robot = Pose(-2.0, 0.5, heading)
    distance, bearing = robot.polar(robot.apply((-1.0, 0.2)))
    assert distance == pytest.approx(math.hypot(1.0, 0.2))
    assert bearing == pytest.approx(math.atan2(0.2, -1.0))


@pytest.mark.parametrize("angle", [-3.0, -0.5, 0.0, 1.0, 3.1])
def test_yaw_of_a_quaternion(angle):
    assert yaw(turn(angle)) == pytest.approx(angle)


def test_rotating_about_z_and_x():
    z = turn(QUARTER)
    assert rotate((z.x, z.y, z.z, z.w), (1, 2, 3)) == pytest.approx((-2, 1, 3))
    x = turn(0.0, QUARTER)
    assert rotate((x.x, x.y, x.z, x.w), (1, 2, 3)) == pytest.approx((1, -3, 2))


def test_a_camera_looks_along_z():
    # Optical frame: z ahead, x to the right, y down.
    optical = Fields(x=-0.5, y=0.5, z=-0.5, w=0.5)
    seen = transformed(
        Fields(translation=point(0.1, 0.0, 1.0), rotation=optical), point(0.5, 0.2, 3)
    )
    assert seen == pytest.approx((3.1, -0.5))


def test_a_lidar_on_its_feet_and_one_upside_down():
    assert mounted(transform(0.1, -0.2, QUARTER)) == ((0.1, -0.2, pytest.approx(QUARTER)), False)
    place, upside_down = mounted(transform(0.0, 0.0, QUARTER, roll=math.pi))
    assert upside_down
    assert place.yaw == pytest.approx(QUARTER)


def test_a_lidar_that_looks_at_the_floor_is_refused():
    with pytest.raises(ValueError, match="tilted by 90 degrees, a planar one by at most 10"):
        mounted(transform(0.0, 0.0, roll=QUARTER))
