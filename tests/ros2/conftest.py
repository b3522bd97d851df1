"""Without ROS the tests in two processes are skipped, and say where they run."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest


class _NeedsRos(pytest.Directory):
    def collect(self):
        pytest.skip(
            "rclpy is not installed: `make test-ros` installs it beside .venv and runs these tests",
            allow_module_level=True,
        )


def pytest_collect_directory(path: Path, parent: pytest.Collector) -> pytest.Directory | None:
    if path.name == "loopback" and importlib.util.find_spec("rclpy") is None:
        return _NeedsRos.from_parent(parent, path=path)
    return None
