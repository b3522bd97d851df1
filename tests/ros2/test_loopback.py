"""Says what is left out where there is no ROS."""

from __future__ import annotations

import importlib.util

import pytest


def test_the_node_and_its_robot_in_two_processes():
    if importlib.util.find_spec("rclpy") is None:
        pytest.skip(
            "rclpy is not installed: make test-ros installs it and runs tests/ros2/loopback"
        )
