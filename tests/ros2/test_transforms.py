"""tf2 as the node asks it; its wheels are not on PyPI, so that its part is played here."""

from __future__ import annotations

import sys
from types import ModuleType, SimpleNamespace

import pytest
from torchrl_morl_ros.transforms import listen

from ._messages import transform


class _NoTransformError(Exception):
    pass


@pytest.fixture
def tf2(monkeypatch):
    """``tf2_ros`` and ``rclpy.time`` with the names and signatures that ``listen`` relies on."""
    known = {("odom", "map"): transform(1.0, 2.0)}

    class Buffer:
        def lookup_transform(self, target_frame, source_frame, time):
            assert time == "newest"
            if (target_frame, source_frame) not in known:
                raise _NoTransformError(f'"{source_frame}" does not exist.')
            return SimpleNamespace(transform=known[target_frame, source_frame])

    ros = ModuleType("tf2_ros")
    ros.Buffer, ros.TransformException = Buffer, _NoTransformError
    ros.TransformListener = lambda buffer, node: (buffer, node)
    time = ModuleType("rclpy.time")
    time.Time = lambda: "newest"
    for name, module in (("tf2_ros", ros), ("rclpy", ModuleType("rclpy")), ("rclpy.time", time)):
        monkeypatch.setitem(sys.modules, name, module)


def test_the_newest_transform_is_asked_for(tf2):
    lookup, kept = listen("the node")
    assert kept[1] == "the node"
    assert (lookup("odom", "map").translation.x, lookup("odom", "map").translation.y) == (1.0, 2.0)


def test_a_transform_that_nobody_knows_is_a_line(tf2):
    lookup, _ = listen("the node")
    with pytest.raises(
        LookupError, match="no transform from 'laser' to 'odom': \"laser\" does not"
    ):
        lookup("odom", "laser")
