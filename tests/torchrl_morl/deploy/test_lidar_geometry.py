"""Sectors of any lidar: by hand, against the pooling of the training, and against an independent loop."""

from __future__ import annotations

import dataclasses
import math
import re

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torchrl_morl.deploy import LidarGeometry, Sensing
from torchrl_morl.transforms import LidarMinPool

NAN, INF = math.nan, math.inf
DEGREE = math.pi / 180


def full(beams: int, /, **changes) -> LidarGeometry:
    arguments = {
        "first_angle": 0.0,
        "increment": 2 * math.pi / beams,
        "num_beams": beams,
        "range_min": 0.1,
        "range_max": 8.0,
    }
    return LidarGeometry(**arguments | changes)


@pytest.mark.parametrize(
    ("reading", "expected"),
    [
        (0.5, 0.5),
        (0.1, 0.1),
        (4.0, 4.0),
        (5.0, 4.0),  # further than the policy looks
        (8.0, 4.0),  # range_max and above is free
        (100.0, 4.0),
        (INF, 4.0),
        (NAN, NAN),
        (0.0, NAN),
        (0.09, NAN),
        (-1.0, NAN),
        (-INF, 0.1),  # too close to be measured
    ],
)
def test_a_reading_means_one_thing(reading, expected):
    sectors = full(4).sectors([1.0, reading, 2.0, 3.0], 4, 4.0)
    np.testing.assert_array_equal(sectors, [1.0, expected, 2.0, 3.0])


def test_zero_is_invalid_also_without_a_range_min():
    sectors = full(4, range_min=0.0).sectors([1.0, 0.0, -0.0, 1e-3], 4, 4.0)
    np.testing.assert_array_equal(sectors, [1.0, NAN, NAN, 1e-3])


def test_the_nearest_valid_beam_of_a_sector_counts():
    ranges = [3.0, 0.0, 2.0, NAN, INF, 1.0, NAN, 0.0]
    np.testing.assert_array_equal(full(8).sectors(ranges, 4, 4.0), [3.0, 2.0, 1.0, NAN])


def test_the_native_scan_is_pooled_as_in_training():
    scan = np.random.default_rng(0).uniform(0.1, 4.0, (5, 720)).astype(np.float32)
    pooled = LidarMinPool(30)(TensorDict(scan=torch.from_numpy(scan)))["lidar"].numpy()
    lidar = full(720, range_max=4.0)
    np.testing.assert_array_equal(lidar.sectors(scan, 30, 4.0), pooled)
    # The same beams in the other order are the same sectors.
    clockwise = full(720, increment=-2 * math.pi / 720, range_max=4.0)
    mirrored = np.roll(scan[:, ::-1], 1, axis=-1)
    np.testing.assert_array_equal(clockwise.sectors(mirrored, 30, 4.0), pooled)
    # And from any first beam, with a yaw of the mount.
    turned = full(720, first_angle=-math.pi, range_max=4.0, mount=(0.0, 0.0, math.pi / 2))
    shifted = np.roll(scan, 180, axis=-1)  # beam 0 points to -90 degrees
    np.testing.assert_array_equal(turned.sectors(shifted, 30, 4.0), pooled)


@pytest.mark.parametrize("num_beams", [90, 180, 360, 541, 667, 1081, 1440, 2000])
@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("view", [270, 360])
def test_any_lidar_against_a_loop(num_beams, direction, view):
    rng = np.random.default_rng(num_beams)
    first = rng.uniform(-math.pi, math.pi)
    increment = direction * view * DEGREE / num_beams
    ranges = rng.uniform(0.05, 9.0, num_beams)
    ranges[rng.random(num_beams) < 0.1] = NAN
    lidar = full(num_beams, first_angle=first, increment=increment)
    expected = np.full(30, NAN)
    for beam, value in enumerate(ranges):
        if not value >= 0.1:
            continue
        angle = math.fmod(first + beam * increment, 2 * math.pi) % (2 * math.pi)
        sector = int(angle / (12 * DEGREE)) % 30
        expected[sector] = np.fmin(expected[sector], 4.0 if value >= 8.0 else min(value, 4.0))
    np.testing.assert_allclose(lidar.sectors(ranges, 30, 4.0), expected)


def test_what_is_out_of_view_is_unknown():
    lidar = full(541, first_angle=-135 * DEGREE, increment=0.5 * DEGREE)
    unknown = np.flatnonzero(np.isnan(lidar.sectors(np.ones(541), 30, 4.0)))
    # 135 degrees is within sector 11, 225 within sector 18.
    np.testing.assert_array_equal(unknown, range(12, 18))


def test_float32_angles_of_a_driver_do_not_move_a_beam():
    """LaserScan's fields are float32: the beam at 12 degrees must not slip into the sector before."""
    increment = float(np.float32(0.5 * DEGREE))
    lidar = full(720, first_angle=float(np.float32(-math.pi)), increment=increment)
    ranges = np.full(720, 4.0)
    ranges[360 + 24] = 1.0  # 12 degrees
    np.testing.assert_array_equal(np.flatnonzero(lidar.sectors(ranges, 30, 4.0) == 1.0), [1])


def test_the_last_beam_may_be_the_first_again():
    ranges = np.full(721, 2.0)
    ranges[720] = 1.0
    sectors = full(721, increment=0.5 * DEGREE).sectors(ranges, 30, 4.0)
    assert sectors[0] == 1.0 and (sectors[1:] == 2.0).all()


@pytest.mark.parametrize("mount", [(0.2, 0.0, 0.0), (-0.1, 0.15, 1.0), (0.3, -0.2, -2.5)])
def test_a_wall_is_seen_from_the_rotation_centre(mount):
    """A circular wall around the robot is equally far in all sectors, wherever the lidar sits."""
    radius, num_beams = 2.0, 3600
    angle = mount[2] + 2 * math.pi * np.arange(num_beams) / num_beams
    toward = mount[0] * np.cos(angle) + mount[1] * np.sin(angle)
    ranges = -toward + np.sqrt(toward**2 + radius**2 - mount[0] ** 2 - mount[1] ** 2)
    lidar = full(num_beams, mount=mount)
    np.testing.assert_allclose(lidar.sectors(ranges, 30, 4.0), radius)
    # From where the lidar of the training sat, the distances are those of that place.
    origin = (0.15, 0.0)
    seen = lidar.sectors(ranges, 30, 4.0, origin)
    assert seen.min() == pytest.approx(radius - 0.15, abs=1e-3)
    assert seen.max() == pytest.approx(radius + 0.15, abs=0.02)


def test_an_obstacle_at_a_known_place_changes_its_sector_with_the_mount():
    """1 m ahead of a lidar that is 1 m to the left: at 45 degrees and 1.41 m from the centre."""
    ranges = np.full(360, INF)
    ranges[0] = 1.0
    sectors = full(360, mount=(0.0, 1.0, 0.0)).sectors(ranges, 30, 4.0)
    assert np.flatnonzero(sectors < 4.0).tolist() == [3]
    assert sectors[3] == pytest.approx(math.sqrt(2))


def test_a_lidar_at_the_origin_of_the_training_is_not_touched():
    ranges = np.random.default_rng(0).uniform(0.2, 4.0, 360)
    ahead = full(360, mount=(0.15, 0.0, 0.0)).sectors(ranges, 30, 4.0, (0.15, 0.0))
    np.testing.assert_array_equal(ahead, full(360).sectors(ranges, 30, 4.0))


def test_batches_are_scans_one_by_one():
    lidar = full(541, mount=(0.1, 0.2, 0.3), increment=0.5 * DEGREE)
    ranges = np.random.default_rng(0).uniform(-1.0, 9.0, (2, 3, 541))
    together = lidar.sectors(ranges, 30, 4.0)
    assert together.shape == (2, 3, 30)
    for index in np.ndindex(2, 3):
        np.testing.assert_array_equal(together[index], lidar.sectors(ranges[index], 30, 4.0))


def test_input_is_not_changed_and_may_be_anything():
    ranges = np.array([1.0, 0.0, INF, 2.0], dtype=np.float32)
    before = ranges.copy()
    full(4).sectors(ranges, 4, 4.0)
    np.testing.assert_array_equal(ranges, before)
    np.testing.assert_array_equal(full(4).sectors([1, 2, 3, 4], 4, 4.0), [1, 2, 3, 4])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"first_angle": NAN}, "first_angle must be finite"),
        ({"increment": 0.0}, "increment must be different from 0"),
        ({"increment": 0.5}, "180 beams every 0.5 rad are more than a revolution: is the incr"),
        ({"num_beams": 0}, "num_beams must be at least 1"),
        ({"num_beams": 1.5}, "num_beams must be an integer"),
        ({"range_min": -0.1}, "range_min must be between 0 and range_max"),
        ({"range_min": 9.0}, "range_min must be between 0 and range_max, 8, got 9"),
        ({"range_max": INF}, "range_max must be finite"),
        ({"mount": (0.0, 0.0)}, "mount must be x, y and yaw"),
        ({"mount": (0.0, NAN, 0.0)}, "mount must be x, y and yaw, all finite"),
        ({"mount": (0.0, "0", 0.0)}, "mount must be x, y and yaw, all finite"),
        ({"mount": "abc"}, "mount must be x, y and yaw"),
        ({"mount": None}, "mount must be x, y and yaw, got None"),
        ({"increment": "0.1"}, "increment must be finite, got '0.1'"),
        ({"first_angle": None}, "first_angle must be finite, got None"),
        ({"range_max": 10**400}, "range_max must be finite"),
        ({"num_beams": "180"}, "num_beams must be an integer, got '180'"),
        ({"first_angle": -180}, "first_angle must be within a revolution, in radians, got -180"),
        ({"first_angle": 1e300}, "first_angle must be within a revolution"),
        ({"mount": (120.0, 0.0, 0.0)}, "mount must be within 10 m of the rotation centre"),
        ({"mount": (0.0, 0.0, 90)}, "mount must be x, y and yaw, which is within a revolution"),
        ({"increment": 1e-13, "num_beams": 10**12}, "num_beams must be at most 1000000"),
    ],
)
def test_a_geometry_that_makes_no_sense(changes, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        full(180, **changes)


def test_numbers_of_numpy_are_numbers():
    plain = full(180)
    same = dataclasses.replace(
        plain,
        num_beams=np.int64(180),
        mount=np.zeros(3),
        range_min=np.float32(plain.range_min),
    )
    assert isinstance(same.num_beams, int) and same.mount == (0.0, 0.0, 0.0)
    hash(same)


def test_a_scan_of_another_size():
    with pytest.raises(ValueError, match=r"ranges must have shape \[\.\.\., 180\], .* got \[181\]"):
        full(180).sectors(np.ones(181), 30, 4.0)
    with pytest.raises(ValueError, match="ranges must be numbers"):
        full(2).sectors(["a", "b"], 30, 4.0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0, 4.0), "num_sectors must be at least 1, got 0"),
        ((1.5, 4.0), "num_sectors must be a whole number, at least 1, got 1.5"),
        ((30, NAN), "max_range must be positive and finite, got nan"),
        ((30, -1.0), "max_range must be positive and finite, got -1.0"),
        ((30, 4.0, (NAN, 0.0)), "origin must be x and y, both finite, got (nan, 0.0)"),
        ((30, 4.0, (0.0, 0.0, 0.0)), "origin must be x and y, both finite"),
        ((30, 4.0, None), "origin must be x and y, both finite, got None"),
    ],
)
def test_sectors_that_make_no_sense(arguments, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        full(180).sectors(np.ones(180), *arguments)


def test_a_lidar_too_coarse_for_the_policy():
    full(30).check(Sensing())
    with pytest.raises(ValueError, match=r"beams every 18\.0 degrees leave sectors of 12\.0 degr"):
        full(20).check(Sensing())


# --- the transform of the training, with readings of a real lidar --------------------------------


@pytest.mark.parametrize(
    ("reading", "expected"),
    [(0.5, 0.5), (0.0, 3.0), (-1.0, 3.0), (NAN, 3.0), (0.05, 3.0), (INF, 3.0), (-INF, 0.1)],
)
def test_the_transform_leaves_invalid_rays_out(reading, expected):
    pool = LidarMinPool(2, range_min=0.1, range_max=4.0)
    scan = torch.tensor([[reading, 3.0, INF, NAN]])
    lidar = pool(TensorDict(scan=scan, batch_size=[1]))["lidar"]
    torch.testing.assert_close(lidar, torch.tensor([[expected, 4.0]]))


def test_the_transform_and_the_geometry_agree():
    rng = np.random.default_rng(0)
    scan = rng.uniform(-0.5, 6.0, (20, 720))
    scan[rng.random(scan.shape) < 0.2] = NAN
    scan[rng.random(scan.shape) < 0.1] = INF
    pool = LidarMinPool(30, range_min=0.1, range_max=4.0)
    pooled = pool(TensorDict(scan=torch.from_numpy(scan), batch_size=[20]))["lidar"].numpy()
    sectors = full(720, range_max=4.0).sectors(scan, 30, 4.0)
    np.testing.assert_array_equal(np.where(np.isnan(sectors), 4.0, sectors), pooled)


@pytest.mark.parametrize("limits", [(0.1, None), (None, 4.0), (4.0, 0.1), (-1.0, 4.0), (0.1, INF)])
def test_the_transform_refuses_limits_that_make_no_sense(limits):
    with pytest.raises(ValueError, match="range_min and range_max must both be given"):
        LidarMinPool(30, range_min=limits[0], range_max=limits[1])
