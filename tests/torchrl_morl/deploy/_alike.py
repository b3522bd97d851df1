"""Whether two runners command the same: that of the library, and one without PyTorch."""

from __future__ import annotations

from typing import Any

import pytest

from torchrl_morl.deploy import Command, LidarGeometry, PolicyRunner
from torchrl_morl.testing import sensor_readings

from ._stops import step

LIMITS = [{"max_speed": 0.2}, {"max_turn_rate": 0.1}, {"timeout": 1.0}]


def check_command(found: Command, expected: Command, turn_rate: float = 1e-4) -> None:
    assert (found.reason, found.valid_until) == (expected.reason, expected.valid_until)
    assert found.speed == pytest.approx(expected.speed, abs=1e-5)
    assert found.turn_rate == pytest.approx(expected.turn_rate, abs=turn_rate)


def drive(
    ours: PolicyRunner, other: Any, lidar: LidarGeometry, number: int, **within: float
) -> list[Command]:
    """Readings of all kinds, every fifth without a human; what the other one commanded."""
    readings = sensor_readings(ours.policy, lidar, number, seed=5)
    commands = []
    for index in range(number):
        row = {key: value[index] for key, value in readings.items()}
        ranges = row.pop("ranges")
        if index % 5 == 0:
            row["human"] = None
        expected, found = (r.step(ranges, **row, stamp=index, time=index) for r in (ours, other))
        check_command(found, expected, **within)
        commands.append(found)
    assert sum(command.reason == "drive" for command in commands) > 0.75 * number
    return commands


def check_velocities(ours: PolicyRunner, other: Any) -> None:
    """Of a human who is seen, seen again, given with the same inputs again, gone for two seconds, and jumps."""
    for time, stamp, human in [
        (10.0, 10.0, (2.0, 0.5)),
        (10.2, 10.2, (1.9, 0.6)),
        (10.3, 10.2, (1.9, 0.6)),
        (12.5, 12.5, (1.5, 0.9)),
        (12.7, 12.7, (4.0, 0.9)),
        (12.9, 12.9, (4.0, 0.95)),
    ]:
        given = {"stamp": stamp, "human": human, "odometry": (0.1 * time, 0.2, 0.3 * time)}
        expected, found = (step(runner, time, **given) for runner in (ours, other))
        assert expected.reason == "drive"
        check_command(found, expected)
    missing = step(other, 20.0)
    assert missing.reason == "refused" and "reads the human's velocity" in missing.detail


def check_limits(ours: PolicyRunner, other: Any) -> None:
    """A sharp turn, and inputs that are 0.8 s old."""
    for time, given in ((10.0, {"goal": (3.0, 1.0)}), (10.8, {"stamp": 10.0})):
        expected, found = (step(runner, time, **given) for runner in (ours, other))
        check_command(found, expected)
