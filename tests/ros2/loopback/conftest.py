"""Two processes: the node in one, the simulation as its robot in this one. They need rclpy."""

from __future__ import annotations

import os

import pytest

TABLE: list[tuple[str, ...]] = []
"""Delays that the tests have measured, for the end of the report."""


def pytest_terminal_summary(terminalreporter) -> None:
    if not TABLE:
        return
    terminalreporter.section("from a fault to standing, seconds")
    for row in TABLE:
        terminalreporter.write_line("  ".join(row))


@pytest.fixture(scope="module")
def loopback(tmp_path_factory):
    """A ROS domain of this process and its children alone."""
    import rclpy

    domain = 1 + os.getpid() % 100
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", str(domain))
        patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        patch.setenv("ROS_LOG_DIR", str(tmp_path_factory.mktemp("ros_log")))
        rclpy.init()
        yield tmp_path_factory.mktemp("node")
        rclpy.try_shutdown()
        # A test that has failed leaves its node behind.
        from ._robot import NodeProcess

        while NodeProcess.running:
            NodeProcess.running.pop().kill()
