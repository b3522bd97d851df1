"""The graph from ranges to a command: hand-made scans, and the runner's numbers for any lidar."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from torchrl_morl.deploy import (
    LidarGeometry,
    PolicyGraph,
    PolicyRunner,
    Sensing,
    load_policy,
    training_lidar,
)
from torchrl_morl.deploy.graph import SectorMinima
from torchrl_morl.testing import sensor_readings, untrained_policy

POLICIES = Path(__file__).parents[3] / "recipes" / "policies"
NAN, INF = math.nan, math.inf
LIDARS = {
    "all around": LidarGeometry(0.0, 2 * math.pi / 720, 720, 0.12, 3.5),
    "270 degrees, clockwise": LidarGeometry(2.35, -math.pi / 360, 541, 0.1, 10.0),
    "off the centre": LidarGeometry(-2.3, math.pi / 360, 541, 0.1, 10.0, (0.1, -0.05, 0.3)),
    "off the centre, around": LidarGeometry(0.1, math.pi / 180, 360, 0.3, 8.0, (-0.2, 0.0, 1.0)),
}


def minima(lidar: LidarGeometry, ranges: list[float], **sensing) -> list[float]:
    sectors = SectorMinima(lidar, Sensing(**sensing))
    return sectors(torch.tensor([ranges])).squeeze(0).tolist()


def test_sectors_of_a_hand_made_scan():
    lidar = LidarGeometry(-math.pi / 2, math.pi / 4, 5, range_min=0.5, range_max=8.0)
    # At -90, -45, 0, 45 and 90 degrees: sectors 3, 3, 0, 0, 1 of four.
    found = minima(lidar, [3.0, 0.4, 2.0, INF, -INF], num_sectors=4, unknown_range=3.5)
    assert found == [2.0, 0.5, 3.5, 3.0]
    found = minima(lidar, [9.0, NAN, 8.0, 5.0, -1.0], num_sectors=4, unknown_range=3.5)
    assert found == [4.0, 3.5, 3.5, 4.0]


def test_a_lidar_off_the_centre_sees_end_points_from_there():
    lidar = LidarGeometry(0.0, math.pi / 2, 4, 0.1, 8.0, mount=(-1.0, 0.0, 0.0))
    # Ends at (0, 0), which is straight ahead, (-1, 1), (-2, 0) and (-1, -1): sectors 0, 1, 2 and 2.
    found = minima(lidar, [1.0, 1.0, 1.0, 1.0], num_sectors=4)
    assert found == pytest.approx([0.0, math.sqrt(2), math.sqrt(2), 4.0], abs=1e-12)
    # Free to the left: beams end at 4 m from the lidar, which is how far that is from here.
    found = minima(lidar, [3.0, INF, 1.0, NAN], num_sectors=4)
    assert found == pytest.approx([2.0, 4.0, 2.0, 4.0])


@pytest.mark.parametrize("number", [1, 2, 3, 30])
@pytest.mark.parametrize("lidar", LIDARS.values(), ids=LIDARS)
def test_sectors_are_those_of_the_lidar(lidar, number):
    ranges = sensor_readings(untrained_policy(), lidar, 200, seed=1)["ranges"]
    for origin in ((0.0, 0.0), (0.15, 0.0)):
        expected = lidar.sectors(ranges, number, 4.0, origin)
        sensing = Sensing(num_sectors=number, lidar_origin=origin, unknown_range=3.0)
        found = SectorMinima(lidar, sensing)(torch.from_numpy(ranges)).numpy()
        np.testing.assert_allclose(found, np.where(np.isnan(expected), 3.0, expected), atol=1e-12)


@pytest.mark.parametrize("name", ["polished_seed0", "walking"])
@pytest.mark.parametrize("lidar", LIDARS.values(), ids=LIDARS)
def test_its_commands_are_those_of_the_runner(policy_folders, name, lidar):
    policy = load_policy(policy_folders[name])
    readings = sensor_readings(policy, lidar, 100)
    with torch.inference_mode():
        found = PolicyGraph(policy, lidar)(**tensors(readings)).numpy()
    runner = PolicyRunner(policy, lidar=lidar, goal_radius=1e-6)
    for index in range(100):
        row = {key: value[index] for key, value in readings.items()}
        command = runner.step(row.pop("ranges"), **row, stamp=index, time=index)
        assert command.reason == "drive"
        assert found[index] == pytest.approx((command.speed, command.turn_rate), abs=1e-4)


def tensors(readings: dict[str, np.ndarray]) -> dict[str, torch.Tensor]:
    return {name: torch.from_numpy(value) for name, value in readings.items()}


def test_a_policy_that_does_not_read_the_human_has_no_such_input():
    policy = untrained_policy(sensing=Sensing(observe_human=False))
    graph = PolicyGraph(policy, training_lidar(policy))
    assert graph.input_names == ("ranges", "goal", "preference")
    readings = sensor_readings(policy, training_lidar(policy), 3)
    assert graph(**tensors(readings)).shape == (3, 2)


def test_what_does_not_go_together_is_refused():
    policy = untrained_policy()
    with pytest.raises(ValueError, match=r"lidar: beams every 40\.0 degrees"):
        PolicyGraph(policy, LidarGeometry(0.0, math.radians(40), 9, 0.1, 4.0))
    with pytest.raises(ValueError, match="does not tell what it senses"):
        PolicyGraph(dataclasses.replace(policy, sensing=None), LIDARS["all around"])
    with pytest.raises(ValueError, match="does not tell what it senses"):
        training_lidar(dataclasses.replace(policy, sensing=None))


def test_the_lidar_of_the_training_is_that_of_the_environment():
    from envs import NavigationEnv
    from envs.policy_env import lidar_geometry

    env = NavigationEnv(num_envs=1, seed=0, num_threads=1)
    ours, theirs = training_lidar(load_policy(POLICIES / "polished_seed0")), lidar_geometry(env)
    env.close()
    assert ours == theirs


def test_readings_of_single_precision_at_the_limits_are_at_the_limits():
    """A driver's 0.12 is float32, a little less than 0.12; its 3.3 is below 3.3 as well."""
    lidar = LidarGeometry(0.0, math.pi / 2, 4, range_min=0.12, range_max=3.3)
    ranges = np.array([0.12, 3.3, 0.1199, 3.2999], dtype=np.float32)
    assert float(ranges[0]) < 0.12 and float(ranges[1]) < 3.3
    expected = [pytest.approx(0.12), 4.0, pytest.approx(NAN, nan_ok=True), pytest.approx(3.2999)]
    assert lidar.sectors(ranges, 4, 4.0).tolist() == expected
    assert lidar.sectors(np.array([0.12, 3.3, 1.0, 1.0]), 4, 4.0).tolist() == [0.12, 4.0, 1.0, 1.0]
