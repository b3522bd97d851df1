"""What the robot sees in the navigation task, against closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from envs import HUMAN_RADIUS
from envs.lidar import compiled
from envs.mjcf import LIDAR_HEIGHT
from tests._navigation import F64, make_env, place

F32 = torch.float32

# --- observations ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("pose", "point", "distance", "bearing"),
    [
        ((0, 0, 0), (3, 4), 5.0, math.atan2(4, 3)),
        ((1, 2, math.pi / 2), (1, 5), 3.0, 0.0),  # straight ahead
        ((1, 2, math.pi / 2), (-1, 2), 2.0, math.pi / 2),  # to the left
        ((1, 2, math.pi / 2), (4, 2), 3.0, -math.pi / 2),  # to the right
        ((0, 0, 3.0), (2, 0), 2.0, -3.0),
        ((0, 0, 7.0), (2, 0), 2.0, 2 * math.pi - 7.0),  # more than a turn
    ],
)
def test_goal_and_human_in_the_frame_of_the_robot(pose, point, distance, bearing):
    env = make_env(scene="empty")
    far = (9.0, -9.0)
    expected = torch.tensor([[distance, bearing]], dtype=F64)
    seen = place(env, pose, goal=point, human=(*far, 0.4))
    torch.testing.assert_close(seen["goal"], expected)
    # The human's own heading does not matter.
    seen = place(env, pose, goal=far, human=(*point, 0.4))
    torch.testing.assert_close(seen["human"], expected)


def _ray_circle(origin, direction, centre, radius):
    offset = origin - centre
    b = (offset * direction).sum(-1)
    discriminant = b**2 - (offset**2).sum(-1) + radius**2
    near = -b - np.sqrt(np.maximum(discriminant, 0))
    return np.where((discriminant >= 0) & (near >= 0), near, np.inf)


def _ray_box(origin, direction, box):
    """Slab method in the frame of the box; the origin is outside."""
    cos, sin = np.cos(box[2]), np.sin(box[2])
    turn = np.array([[cos, -sin], [sin, cos]])
    local, way = (origin - box[:2]) @ turn, direction @ turn
    with np.errstate(divide="ignore"):
        first, second = (-box[3:] - local) / way, (box[3:] - local) / way
    near = np.minimum(first, second).max(-1)
    far = np.maximum(first, second).min(-1)
    return np.where((near <= far) & (near >= 0), near, np.inf)


def _scan_oracle(env, row) -> np.ndarray:
    x, y, heading = row["pose"].tolist()
    forward = np.array([math.cos(heading), math.sin(heading)])
    origin = np.array([x, y]) + env.robot.lidar_offset * forward
    relative = 2 * math.pi * np.arange(env.num_rays) / env.num_rays
    angle = heading + relative
    direction = np.stack((np.cos(angle), np.sin(angle)), axis=-1)
    ranges = _ray_circle(origin, direction, row["human_pose"][:2].numpy(), HUMAN_RADIUS)
    for box in row["scene", "boxes"].numpy():
        ranges = np.minimum(ranges, _ray_box(origin, direction, box))
    from_heading = np.minimum(relative, 2 * math.pi - relative)
    ranges[from_heading > env.robot.lidar_fov / 2 + 1e-6] = np.inf
    return np.minimum(ranges, env.max_range)


@pytest.mark.parametrize("drive", ["planar", "wheels"])
@pytest.mark.parametrize("robot", ["turtlebot2", "hsr"])
@pytest.mark.parametrize("scene", ["static", "moving_human", "corridor"])
def test_the_lidar_against_analytic_intersections(scene, robot, drive):
    env = make_env(num_envs=16, scene=scene, robot=robot, drive=drive)
    current, hits = env.reset(), 0
    for _ in range(10):
        for row in current[~current.get("terminated").squeeze(-1)]:
            expected = _scan_oracle(env, row)
            np.testing.assert_allclose(row["scan"].numpy(), expected, rtol=0, atol=1e-9)
            hits += int((expected < env.max_range).sum())
        for _ in range(3):
            current = env.step(current.set("action", env.action_spec.rand()))["next"]
    assert hits > 1_000


def _mujoco_scan(env, pose: np.ndarray) -> np.ndarray:
    """The scan of robots at ``pose`` [N, 3] by MuJoCo, every ray cast."""
    forward = np.stack((np.cos(pose[:, 2]), np.sin(pose[:, 2]), np.zeros(len(pose))), axis=-1)
    origin = np.array([0, 0, LIDAR_HEIGHT]) + pose * (1, 1, 0) + env.robot.lidar_offset * forward
    relative = 2 * math.pi * np.arange(env.num_rays) / env.num_rays
    angle = pose[:, 2:] + relative
    ranges, _ = env.batch.ray(
        origin[:, None],
        np.stack((np.cos(angle), np.sin(angle), np.zeros_like(angle)), axis=-1),
        geomgroup=[1, 0, 0, 0, 0, 0],
        bodyexclude=env.model.body("robot").id,
    )
    ranges[ranges < 0] = env.max_range
    from_heading = np.minimum(relative, 2 * math.pi - relative)
    ranges[:, from_heading > env.robot.lidar_fov / 2 + 1e-6] = env.max_range
    return ranges.clip(1e-3, env.max_range)


@pytest.mark.parametrize("robot", ["turtlebot2", "hsr"])
@pytest.mark.parametrize("scene", ["static", "corridor", "empty"])
@pytest.mark.parametrize(("num_rays", "dtype"), [(720, F64), (101, F64), (4, F64), (720, F32)])
def test_the_lidar_against_mujoco(num_rays, dtype, scene, robot):
    env = make_env(num_envs=40, scene=scene, robot=robot, num_rays=num_rays, dtype=dtype)
    tolerance = 1e-9 if dtype is F64 else 1e-6
    generator = np.random.default_rng(0)
    for _ in range(5):
        start = env.reset()
        # From inside an obstacle to out of its sight.
        centres = torch.cat((start["human_pose"][:, None, :2], start["scene", "boxes"][..., :2]), 1)
        away = generator.uniform(-math.pi, math.pi, 40)
        distance = generator.uniform(0.0, env.max_range + 1.0, 40)
        pose = np.stack((np.cos(away), np.sin(away), np.zeros(40)), -1) * distance[:, None]
        pose[:, :2] += centres[range(40), generator.integers(centres.shape[1], size=40)].numpy()
        pose[:, 2] = generator.uniform(-math.pi, math.pi, 40)
        start["qpos"] = torch.from_numpy(pose)
        seen = env.reset(start, set_state=True)
        expected = _mujoco_scan(env, seen["pose"].numpy())
        assert seen["scan"].dtype is dtype
        np.testing.assert_allclose(seen["scan"].numpy(), expected, rtol=0, atol=tolerance)
        # Some of the environments only.
        mask = torch.from_numpy(generator.random((40, 1)) < 0.2)
        again = env.reset(seen.clone().set("_reset", mask), set_state=True)
        torch.testing.assert_close(again["scan"], seen["scan"], rtol=0, atol=0)


def test_functions_compile_where_the_result_cannot_be_kept_on_disk():
    # Of no file, and so refused by the cache as on a read-only system without a home.
    namespace = {}
    exec("def double(x): return 2 * x", namespace)
    double = compiled(namespace["double"])
    assert double(3.0) == 6.0
    assert double.signatures


@pytest.mark.parametrize("heading", [0.0, 1.0, -2.5])
def test_ray_0_points_along_the_heading_and_rays_go_counter_clockwise(heading):
    env = make_env(scene="empty")
    for degrees in (0, 45, 90, 200, 359):
        direction = heading + math.radians(degrees)
        human = (2 * math.cos(direction), 2 * math.sin(direction), 0.0)
        scan = place(env, (0, 0, heading), goal=(9, 9), human=human)["scan"][0]
        assert int(scan.argmin()) == 2 * degrees
        torch.testing.assert_close(scan.min(), torch.tensor(2 - HUMAN_RADIUS, dtype=F64))
        # Half the angle that a circle of 0.25 m fills at 2 m.
        assert int((scan < 4).sum()) == 1 + 2 * int(2 * math.degrees(math.asin(0.125)))


def test_the_hsr_sees_270_degrees_from_ahead_of_its_centre():
    env = make_env(scene="empty", robot="hsr")
    scan = place(env, (0, 0, 0), goal=(9, 9), human=(2, 0, 0))["scan"][0]
    torch.testing.assert_close(scan[0], torch.tensor(2 - 0.15 - HUMAN_RADIUS, dtype=F64))
    # The human all around the robot, close by: what is behind stays dark.
    seen = torch.zeros(720, dtype=torch.bool)
    for angle in torch.arange(0, 2 * math.pi, 0.2).tolist():
        human = (0.8 * math.cos(angle), 0.8 * math.sin(angle), 0.0)
        seen |= place(env, (0, 0, 0), goal=(9, 9), human=human)["scan"][0] < 4.0
    angle = 0.5 * torch.arange(720)
    assert torch.equal(seen, (angle <= 135.0) | (angle >= 225.0))


def test_rays_and_range_are_choices():
    env = make_env(scene="empty", num_rays=4, max_range=1.5)
    scan = place(env, (0, 0, 0), goal=(9, 9), human=(0, 1, 0))["scan"][0]
    torch.testing.assert_close(scan, torch.tensor([1.5, 0.75, 1.5, 1.5], dtype=F64))
