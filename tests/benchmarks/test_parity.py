"""Six ways to run one policy: the same commands, and the same drives from start to end."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks import parity
from benchmarks.cpp_library import compiler
from torchrl_morl.deploy import load_policy, training_lidar
from torchrl_morl.testing import sensor_readings

pytestmark = [
    pytest.mark.benchmark,
    pytest.mark.skipif(compiler() is None, reason="there is no C++ compiler"),
]
POLISHED = Path(__file__).parents[2] / "recipes" / "policies" / "polished_seed0"

pytest.importorskip("onnxscript")


@pytest.fixture(scope="module")
def policy():
    return load_policy(POLISHED)


@pytest.fixture(scope="module")
def ways(policy, tmp_path_factory):
    return parity.ways(policy, POLISHED, training_lidar(policy), tmp_path_factory.mktemp("ways"))


def test_their_commands_are_the_same(policy, ways):
    readings = sensor_readings(policy, training_lidar(policy), 300, seed=11)
    trained = parity.as_in_training(readings, policy)
    assert np.isfinite(trained["ranges"]).all()
    reference = ways[0].commands(trained)
    assert reference.shape == (300, 2) and np.ptp(reference, axis=0).min() > 0.1
    for way in ways[1:]:
        difference = parity.largest(way.commands(trained), reference)
        assert difference[0] < 1e-5 and difference[1] < 1e-4, way.name
    reference = ways[1].commands(readings)
    for way in ways[2:]:
        difference = parity.largest(way.commands(readings), reference)
        assert difference[0] < 1e-5 and difference[1] < 1e-4, way.name


def test_the_robot_drives_the_same_with_each(policy, ways):
    preference = np.array([[0.2, 0.5, 0.3]])
    reference = parity.drive(policy, None, preference, scenes=2, seed=3)
    assert (reference["end"] == "success").all()
    for way in ways[1:]:
        driven = parity.drive(policy, way, preference, scenes=2, seed=3)
        distance, same = parity.compared(driven, reference)
        assert same == "2 of 2" and float(distance.split()[0]) < 1e-4, way.name


def test_drives_that_differ_are_found():
    path = np.zeros((2, 3, 2))
    other = path.copy()
    path[0, 2] = np.nan
    other[1, 1] = (0.3, 0.4)
    ends = np.array(["success", "timeout"], object)
    found = parity.compared({"path": path, "end": ends}, {"path": other, "end": ends})
    assert found == ["5.0e-01 m", "1 of 2"]
