"""The navigation task: rewards, ends of episodes, sensors, motion and faults, against closed forms."""

from __future__ import annotations

import functools
import math

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from envs import HSR, HUMAN_RADIUS, TURTLEBOT2, NavigationEnv, Perturbation
from envs.mjcf import LIDAR_HEIGHT

F64 = torch.float64
# Float64 leaves rounding of the simulation alone in comparisons with closed forms.
make_env = functools.partial(NavigationEnv, num_threads=1, seed=0, dtype=F64)


def _place(env: NavigationEnv, pose, **scene) -> TensorDict:
    """Start an episode with the robots at ``pose`` (x, y, heading), and goal, human or boxes given."""
    start = env.reset()
    start["qpos"] = torch.as_tensor(pose, dtype=F64).expand(env.num_envs, 3).clone()
    for key, value in scene.items():
        key = "human_pose" if key == "human" else ("scene", key)
        start[key] = torch.as_tensor(value, dtype=F64).expand(start[key].shape).clone()
    return env.reset(start, set_state=True)


def _drive(env: NavigationEnv, current: TensorDict, action, steps: int) -> TensorDict:
    """The next ``steps`` transitions under one action, without resets, ``[N, steps]``."""
    action = torch.as_tensor(action, dtype=env.dtype).expand(env.num_envs, 2)
    out = []
    for _ in range(steps):
        current = env.step(current.set("action", action.clone()))["next"]
        out.append(current.clone())
    return torch.stack(out, 1)


def _random_drive(env: NavigationEnv, current: TensorDict, steps: int) -> TensorDict:
    out = []
    for _ in range(steps):
        current = env.step(current.set("action", env.action_spec.rand()))["next"]
        out.append(current.clone())
    return torch.stack(out, 1)


# --- rewards -----------------------------------------------------------------------------------


def test_the_core_reward_telescopes_to_the_distance_gained():
    env = make_env(num_envs=8, scene="empty")
    start = env.reset()
    steps = _random_drive(env, start, 20)
    assert not steps["terminated"].any()
    gained = start["goal"][:, 0] - steps["goal"][:, -1, 0]
    assert gained.abs().max() > 0.1
    torch.testing.assert_close(steps["reward"][..., 0].sum(-1), 125 * gained)


def test_driving_towards_the_goal_pays_and_away_costs():
    env = make_env(scene="empty")
    reward = []
    for heading in (0.0, math.pi):
        start = _place(env, (0, 0, heading), goal=(9, 0), human=(4, 9, 0))
        # From the third step on the robot drives at 0.5 m/s: 0.1 m a step.
        reward.append(_drive(env, start, (0.5, 0.0), 5)["reward"][0, 3:, 0])
    torch.testing.assert_close(reward[0], torch.full((2,), 12.5, dtype=F64), rtol=1e-4, atol=0)
    torch.testing.assert_close(reward[1], -reward[0], rtol=1e-4, atol=0)


@pytest.mark.parametrize(
    ("distance", "penalty"),
    [
        (2.5, 0.0),
        (2.0, 0.0),
        (1.15, -2.5),  # half of 2 - 0.3 metres inside the threshold: a quarter
        (0.6, -10 * (1.4 / 1.7) ** 2),
    ],
)
def test_the_distance_penalty_by_hand(distance, penalty):
    env = make_env(scene="empty")
    for bearing in (0.0, 2.0, math.pi):
        human = (1 + distance * math.cos(bearing), 2 + distance * math.sin(bearing), 0.0)
        start = _place(env, (1, 2, 0.3), goal=(9, 9), human=human)
        reward = _drive(env, start, (0.0, 0.0), 1)["reward"][0, 0]
        expected = torch.tensor([0.0, penalty, -10.0], dtype=F64)
        torch.testing.assert_close(reward, expected, rtol=0, atol=1e-9)


def test_the_penalty_counts_the_distance_after_the_step():
    env = make_env(scene="moving_human", num_envs=4)
    steps = _random_drive(env, _place(env, (6, 0, 0), human=(8, 0, math.pi)), 15)
    distance = (steps["pose"][..., :2] - steps["human_pose"][..., :2]).norm(dim=-1)
    assert (distance < 2).any()
    expected = -10 * ((2 - distance).clamp_min(0) / 1.7) ** 2
    torch.testing.assert_close(steps["reward"][..., 1], expected)


def test_every_step_costs_ten():
    env = make_env(num_envs=4)
    assert (_random_drive(env, env.reset(), 10)["reward"][..., 2] == -10).all()


# --- ends of episodes --------------------------------------------------------------------------


def _until_done(env: NavigationEnv, current: TensorDict, action=(0.5, 0.0)) -> TensorDict:
    steps = _drive(env, current, action, 60)
    end = int(steps["done"][0, :, 0].int().argmax())
    assert steps["done"][0, end].all()
    return steps[0, : end + 1]


def _flags(step: TensorDict) -> list[bool]:
    keys = ("success", "collision_human", "collision_obstacle", "terminated", "truncated")
    return [bool(step[key]) for key in keys]


def test_driving_into_the_human():
    env = make_env(scene="empty")
    steps = _until_done(env, _place(env, (0, 0, 0), goal=(9, 0), human=(2, 0.1, 0)))
    touching = TURTLEBOT2.radius + HUMAN_RADIUS
    distance = (steps["pose"][:, :2] - steps["human_pose"][:, :2]).norm(dim=-1)
    assert distance[-1] <= touching < distance[-2]
    assert _flags(steps[-1]) == [False, True, False, True, False]
    gained = 125 * (steps["goal"][-2, 0] - steps["goal"][-1, 0])
    torch.testing.assert_close(steps["reward"][-1, 0], gained - 1000)
    assert (steps["reward"][:-1, 0] > 0).all()


def test_driving_into_a_box():
    env = make_env()
    boxes = [(2.0, 0.0, 0.0, 0.5, 0.3), (0, 5, 0, 0.2, 0.2), (0, -5, 0, 0.2, 0.2)]
    start = _place(env, (0, 0, 0), goal=(9, 0), human=(5, 3, 0), boxes=boxes)
    steps = _until_done(env, start)
    assert steps["pose"][-1, 0] >= 1.5 - TURTLEBOT2.radius > steps["pose"][-2, 0]
    assert _flags(steps[-1]) == [False, False, True, True, False]
    assert steps["reward"][-1, 0] < -900


@pytest.mark.parametrize("goal_radius", [0.3, 0.6])
def test_reaching_the_goal(goal_radius):
    env = make_env(scene="empty", goal_radius=goal_radius)
    steps = _until_done(env, _place(env, (0, 0, 0), goal=(2, 0), human=(0, 5, 0)))
    distance = steps["goal"][:, 0]
    assert distance[-1] <= goal_radius < distance[-2]
    assert _flags(steps[-1]) == [True, False, False, True, False]
    assert (steps["reward"][:, 0] > 0).all()


def test_a_collision_in_the_step_that_reaches_the_goal_is_no_success():
    env = make_env(scene="empty", goal_radius=0.43)
    steps = _until_done(env, _place(env, (0, 0, 0), goal=(2, 0), human=(2, 0, 0)))
    assert steps["goal"][-1, 0] <= TURTLEBOT2.radius + HUMAN_RADIUS and steps["goal"][-2, 0] > 0.43
    assert _flags(steps[-1]) == [False, True, False, True, False]


def test_truncation_after_300_steps():
    env = make_env(num_rays=1)
    steps = _drive(env, env.reset(), (0.0, 0.0), 300)
    assert not steps["done"][:, :299].any()
    assert _flags(steps[0, 299]) == [False, False, False, False, True]


def test_an_episode_that_ends_in_its_last_step_is_terminated_not_truncated():
    start = {"pose": (0, 0, 0), "goal": (9, 0), "human": (1, 0, 0)}
    env = make_env(scene="empty")
    length = len(_until_done(env, _place(env, **start)))
    env = make_env(scene="empty", max_episode_steps=length)
    steps = _until_done(env, _place(env, **start))
    assert len(steps) == length and _flags(steps[-1]) == [False, True, False, True, False]


@pytest.mark.parametrize("scene", ["static", "corridor", "moving_human", "empty"])
def test_causes_exclude_each_other_and_make_up_termination(scene):
    env = make_env(num_envs=256, scene=scene, num_rays=1)
    start = env.reset()
    # Start all over the scene, in collisions and goals too.
    unit = torch.rand(256, 2, dtype=F64)
    start["qpos"][:, :2] = start["scene", "goal"] * unit[:, :1] + 2 * unit - 1
    steps = _random_drive(env, env.reset(start, set_state=True), 12)
    causes = torch.cat([steps[k] for k in ("success", "collision_human", "collision_obstacle")], -1)
    assert torch.equal(causes.sum(-1, keepdim=True) == 1, steps["terminated"])
    assert (causes.sum(-1) <= 1).all()
    assert not (steps["terminated"] & steps["truncated"]).any()
    boxes = scene != "empty"
    assert causes.any(1).any(0).tolist() == [True, True, boxes]


@pytest.mark.parametrize("snapshots", [True, False])
def test_causes_outlive_the_reset_that_follows(snapshots):
    env = make_env(num_envs=32, num_rays=1, snapshots=snapshots)
    current, ends = env.reset(), 0
    for _ in range(60):
        # Straight ahead: some arrive at a box, none at the same time as all others.
        action = torch.tensor([0.5, 0.0], dtype=F64).expand(32, 2)
        step, current = env.step_and_maybe_reset(current.set("action", action))
        after = step["next"]
        causes = after["success"] | after["collision_human"] | after["collision_obstacle"]
        assert torch.equal(causes, after["terminated"])
        assert not any(current[key][after["done"]].any() for key in ("success", "collision_human"))
        ends += int(causes.sum())
    assert ends > 10


@pytest.mark.parametrize("scene", ["static", "moving_human", "corridor"])
def test_a_seed_fixes_the_same_scenes_for_any_number_of_environments(scene):
    keys = ("pose", "human_pose", ("scene", "goal"), ("scene", "human_goal"), ("scene", "boxes"))
    streams = []
    for num_envs in (1, 6, 150):
        env = make_env(num_envs=num_envs, scene=scene, num_rays=1)
        starts = torch.cat([env.reset() for _ in range(150 // num_envs)])
        streams.append([starts[key] for key in keys])
    # Resets of some environments take from the same stream, in the order of their rows.
    env = make_env(num_envs=6, scene=scene, num_rays=1)
    first = env.reset()
    mask = torch.tensor([[False], [True], [False], [False], [True], [True]])
    env.reset(TensorDict({"_reset": mask}, batch_size=[6]))
    third = env.reset()
    for key, *values in zip(keys, *streams, strict=True):
        assert torch.equal(values[0], values[1]) and torch.equal(values[0], values[2]), key
        assert torch.equal(
            torch.cat((first[key], third[key])), values[0][[*range(6), *range(9, 15)]]
        )


@pytest.mark.parametrize("robot", [TURTLEBOT2, HSR], ids=lambda robot: robot.name)
def test_collisions_are_those_of_the_physics(robot):
    env = make_env(num_envs=1_000, robot=robot, num_rays=1)
    start = env.reset()
    # Half the robots at a box, half at the human, from overlapping to well apart.
    unit = torch.rand(1_000, 3, dtype=F64)
    angle, radius = 2 * math.pi * unit[:, 0], robot.radius + 1.2 * unit[:, 1]
    around = start["scene", "boxes"][:, 1, :2].clone()
    around[500:] = start["human_pose"][500:, :2]
    start["qpos"][:, 0] = around[:, 0] + radius * angle.cos()
    start["qpos"][:, 1] = around[:, 1] + radius * angle.sin()
    start["qpos"][:, 2] = 2 * math.pi * unit[:, 2]
    current = env.reset(start, set_state=True)
    contacts = env.batch.bind("ncon")
    seen = torch.zeros(2, dtype=torch.int64)
    for _ in range(8):
        current = env.step(current.set("action", env.action_spec.rand()))["next"]
        env.batch.forward()
        touching = torch.from_numpy(contacts > 0).reshape(-1)
        flagged = (current["collision_human"] | current["collision_obstacle"]).squeeze(-1)
        assert torch.equal(flagged, touching)
        seen += torch.stack((flagged, ~flagged)).sum(-1)
    assert (seen > 400).all()


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
    seen = _place(env, pose, goal=point, human=(*far, 0.4))
    torch.testing.assert_close(seen["goal"], expected)
    # The human's own heading does not matter.
    seen = _place(env, pose, goal=far, human=(*point, 0.4))
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


def _every_ray(env, pose: np.ndarray) -> np.ndarray:
    """The scan of robots at ``pose`` [N, 3] if no ray is left out."""
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
@pytest.mark.parametrize("num_rays", [720, 101, 4])
def test_rays_that_are_not_cast_would_meet_nothing(num_rays, scene, robot):
    env = make_env(num_envs=40, scene=scene, robot=robot, num_rays=num_rays)
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
        expected = _every_ray(env, seen["pose"].numpy())
        np.testing.assert_allclose(seen["scan"].numpy(), expected, rtol=0, atol=1e-9)
        # Some of the environments only, other calls.
        mask = torch.from_numpy(generator.random((40, 1)) < 0.2)
        again = env.reset(seen.clone().set("_reset", mask), set_state=True)
        torch.testing.assert_close(again["scan"], seen["scan"], rtol=0, atol=0)


@pytest.mark.parametrize("heading", [0.0, 1.0, -2.5])
def test_ray_0_points_along_the_heading_and_rays_go_counter_clockwise(heading):
    env = make_env(scene="empty")
    for degrees in (0, 45, 90, 200, 359):
        direction = heading + math.radians(degrees)
        human = (2 * math.cos(direction), 2 * math.sin(direction), 0.0)
        scan = _place(env, (0, 0, heading), goal=(9, 9), human=human)["scan"][0]
        assert int(scan.argmin()) == 2 * degrees
        torch.testing.assert_close(scan.min(), torch.tensor(2 - HUMAN_RADIUS, dtype=F64))
        # Half the angle that a circle of 0.25 m fills at 2 m.
        assert int((scan < 4).sum()) == 1 + 2 * int(2 * math.degrees(math.asin(0.125)))


def test_the_hsr_sees_270_degrees_from_ahead_of_its_centre():
    env = make_env(scene="empty", robot="hsr")
    scan = _place(env, (0, 0, 0), goal=(9, 9), human=(2, 0, 0))["scan"][0]
    torch.testing.assert_close(scan[0], torch.tensor(2 - 0.15 - HUMAN_RADIUS, dtype=F64))
    # The human all around the robot, close by: what is behind stays dark.
    seen = torch.zeros(720, dtype=torch.bool)
    for angle in torch.arange(0, 2 * math.pi, 0.2).tolist():
        human = (0.8 * math.cos(angle), 0.8 * math.sin(angle), 0.0)
        seen |= _place(env, (0, 0, 0), goal=(9, 9), human=human)["scan"][0] < 4.0
    angle = 0.5 * torch.arange(720)
    assert torch.equal(seen, (angle <= 135.0) | (angle >= 225.0))


def test_rays_and_range_are_choices():
    env = make_env(scene="empty", num_rays=4, max_range=1.5)
    scan = _place(env, (0, 0, 0), goal=(9, 9), human=(0, 1, 0))["scan"][0]
    torch.testing.assert_close(scan, torch.tensor([1.5, 0.75, 1.5, 1.5], dtype=F64))


# --- motion ------------------------------------------------------------------------------------


def _speeds(env, action, steps=10):
    """Measured forward speed and turn rate over the last second."""
    steps = _drive(env, _place(env, (0, 0, 0), goal=(9, 9), human=(0, 9, 0)), action, steps)
    pose = steps["pose"][0, -6:]
    turned = torch.diff(pose[:, 2]).remainder(2 * math.pi)
    turned = torch.where(turned > math.pi, turned - 2 * math.pi, turned)
    return float(steps["qvel"][0, -1, :2].norm()), float(turned.mean() / 0.2)


def test_the_base_reaches_its_command():
    env = make_env(scene="empty", num_rays=1)
    assert _speeds(env, (0.5, 0.0)) == (pytest.approx(0.5, abs=1e-4), pytest.approx(0.0, abs=1e-9))
    speed, turn = _speeds(env, (0.0, 2.0))
    assert speed == pytest.approx(0.0, abs=1e-6) and turn == pytest.approx(2.0, abs=1e-3)
    # The velocity follows the heading one time step late: at full turn that costs 0.6 %.
    speed, turn = _speeds(env, (0.5, math.pi))
    assert 0.993 * 0.5 < speed < 0.995 * 0.5 and turn == pytest.approx(math.pi, abs=1e-3)


@pytest.mark.parametrize("robot", ["turtlebot2", "hsr"])
def test_the_response_does_not_depend_on_the_heading_in_the_world(robot):
    heading = torch.linspace(-3.0, 3.0, 13, dtype=F64)
    env = make_env(num_envs=13, scene="empty", num_rays=1, robot=robot)
    pose = torch.stack((torch.zeros(13), torch.zeros(13), heading), dim=-1)
    start = _place(env, pose, goal=(9, 9), human=(0, 9, 0))
    velocity = _drive(env, start, (0.4, 1.5), 6)["qvel"]
    cos, sin = heading.cos()[:, None], heading.sin()[:, None]
    x, y = velocity[..., 0], velocity[..., 1]
    in_start_frame = torch.stack((cos * x + sin * y, cos * y - sin * x, velocity[..., 2]), dim=-1)
    torch.testing.assert_close(in_start_frame, in_start_frame[:1].expand_as(in_start_frame))


def test_0_95_of_the_command_is_reached_within_two_steps():
    env = make_env(scene="empty", num_rays=1)
    start = _place(env, (0, 0, 0), goal=(9, 9), human=(0, 9, 0))
    velocity = _drive(env, start, (0.5, 1.0), 2)["qvel"][0]
    assert velocity[1, :2].norm() > 0.475 and velocity[1, 2] > 0.95
    slow = make_env(scene="empty", num_rays=1, robot="hsr")
    start = _place(slow, (0, 0, 0), goal=(9, 9), human=(0, 9, 0))
    assert _drive(slow, start, (0.5, 1.0), 1)["qvel"][0, 0, 0] < 0.3


def test_actions_are_clamped():
    env, twin = (make_env(num_envs=3) for _ in range(2))
    wild = torch.tensor([[7.0, 9.0], [-3.0, -9.0], [0.2, 99.0]], dtype=F64)
    tame = torch.tensor([[0.5, math.pi], [0.0, -math.pi], [0.2, math.pi]], dtype=F64)
    first, second = (_drive(e, e.reset(), a, 4) for e, a in ((env, wild), (twin, tame)))
    assert torch.equal(first["qpos"], second["qpos"])


@pytest.mark.parametrize("action", [(0.5, 0.0), (0.3, 0.6), (0.5, -0.3), (0.0, 2.0)])
@pytest.mark.parametrize("robot", ["turtlebot2", "hsr"])
def test_rolling_wheels_drive_like_the_planar_base(robot, action):
    moved = []
    for drive in ("planar", "wheels"):
        env = make_env(scene="empty", drive=drive, robot=robot, num_rays=1)
        # Three seconds to get going: wheels follow a turn later than the planar base.
        pose = _drive(env, env.reset(), action, 30)["pose"][0, 15:]
        forward = torch.stack((pose[0, 2].cos(), pose[0, 2].sin()))
        left = torch.stack((-forward[1], forward[0]))
        offset = pose[-1, :2] - pose[0, :2]
        turned = torch.diff(pose[:, 2]).remainder(2 * math.pi)
        turned = torch.where(turned > math.pi, turned - 2 * math.pi, turned).sum()
        moved.append(torch.stack((offset @ forward, offset @ left, turned)))
    path, angle = 14 * 0.2 * action[0], 14 * 0.2 * abs(action[1])
    assert (moved[0] - moved[1])[:2].norm() < 0.02 * path + 0.005
    assert (moved[0] - moved[1])[2].abs() < 0.02 * angle + 0.005


@pytest.mark.parametrize("robot", [TURTLEBOT2, HSR], ids=lambda robot: robot.name)
def test_wheels_grip_when_they_start_and_stop(robot):
    env = make_env(scene="empty", drive="wheels", robot=robot, num_rays=1)
    heading = env.reset()["pose"][0, 2]
    forward = np.array([math.cos(heading), math.sin(heading)])
    wheel = env.model.joint("left_wheel").dofadr[0]
    velocity, ctrl = env.batch.bind("qvel"), env.batch.bind("ctrl")
    speeds = []
    for command in (0.5, 0.0):
        ctrl[:] = command / robot.wheel_radius
        for _ in range(300):
            env.batch.step(nstep=1)
            speeds.append((velocity[0, :2] @ forward, velocity[0, wheel] * robot.wheel_radius))
    base, rim = np.array(speeds).T
    # It takes two time steps until the wheels press on the floor.
    assert np.abs(rim - base)[2:].max() < 0.02
    assert base[:300].max() < 0.505 and base[300:].min() > -0.005  # no overshoot
    assert base[299] == pytest.approx(0.5, abs=0.002) and abs(base[-1]) < 0.002


def test_wheels_start_hardly_later_than_the_planar_base():
    for robot in ("turtlebot2", "hsr"):
        distance = []
        for drive in ("planar", "wheels"):
            env = make_env(scene="empty", drive=drive, robot=robot, num_rays=1)
            start = env.reset()
            pose = _drive(env, start.clone(), (0.5, 0.0), 5)["pose"][0, -1]
            distance.append(float((pose - start["pose"][0])[:2].norm()))
        # To 0.5 m/s at 3 m/s^2, what friction transmits: half of 0.5 m/s for a sixth of a second.
        assert 0 < distance[0] - distance[1] < 0.042, robot


def test_the_human_walks_half_a_metre_a_second_and_stops():
    env = make_env(num_envs=8, scene="moving_human", num_rays=1)
    start = env.reset()
    target = start["scene", "human_goal"]
    length = (target - start["human_pose"][:, :2]).norm(dim=-1)
    steps = _drive(env, start.clone(), (0.0, 0.0), 125)
    way = torch.cat((start["human_pose"][:, None, :2], steps["human_pose"][..., :2]), 1)
    walked = torch.diff(way, dim=1).norm(dim=-1)
    for row in range(8):
        full = int(length[row] / 0.1)
        torch.testing.assert_close(walked[row, :full], torch.full((full,), 0.1, dtype=F64))
        assert (walked[row, full + 1 :] == 0).all()
        torch.testing.assert_close(way[row, -1], target[row])
    torch.testing.assert_close(walked.sum(-1), length)
    assert (steps["human_pose"][..., 2] == math.pi).all()
    standing = make_env(num_envs=2, num_rays=1)
    start = standing.reset()
    after = _drive(standing, start.clone(), (0.0, 0.0), 3)
    assert torch.equal(after["human_pose"][:, -1], start["human_pose"])


# --- faults ------------------------------------------------------------------------------------


def _scans(**kwargs):
    clean = make_env(num_envs=64).reset()["scan"]
    faulty = make_env(num_envs=64, perturbation=Perturbation(**kwargs)).reset()["scan"]
    return clean, faulty


def test_faults_are_off_by_default():
    assert Perturbation() == Perturbation(0.0, 0.0, 0.0, 0) == NavigationEnv().perturbation
    assert torch.equal(*_scans())


def test_range_noise_has_its_standard_deviation_and_spares_rays_without_return():
    clean, faulty = _scans(range_noise=0.05)
    hit = clean < 3.5  # seven standard deviations from the range limit
    noise = (faulty - clean)[hit]
    n = noise.numel()
    assert n > 3_000
    assert abs(noise.mean()) < 5 * 0.05 / math.sqrt(n)
    assert abs(noise.std() / 0.05 - 1) < 5 / math.sqrt(2 * n)
    assert (faulty[clean == 4.0] == 4.0).all()
    assert (faulty > 0).all() and (faulty <= 4).all()


@pytest.mark.parametrize("rate", [0.1, 1.0])
def test_dropout_has_its_rate(rate):
    clean, faulty = _scans(dropout=rate)
    hit = clean < 4.0
    lost = faulty[hit] == 4.0
    tolerance = 5 * math.sqrt(rate * (1 - rate) / int(hit.sum()))
    assert abs(lost.double().mean() - rate) <= tolerance
    assert torch.equal(faulty[hit][~lost], clean[hit][~lost])


@pytest.mark.parametrize("drive", ["planar", "wheels"])
def test_latency_is_exactly_one_step(drive):
    late = make_env(num_envs=3, drive=drive, perturbation=Perturbation(latency=1))
    prompt = make_env(num_envs=3, drive=drive)
    actions = torch.stack([prompt.action_spec.rand() for _ in range(8)])
    delayed = torch.cat((torch.zeros_like(actions[:1]), actions[:-1]))
    runs = []
    for env, sequence in ((late, actions), (prompt, delayed)):
        current = env.reset()
        runs.append([])
        for action in sequence:
            current = env.step(current.set("action", action))["next"]
            runs[-1].append(current["qpos"].clone())
    assert torch.equal(torch.stack(runs[0]), torch.stack(runs[1]))
    # A new episode starts with an empty pipe.
    start = late.reset()
    assert (start["pending_action"] == 0).all()


def test_velocity_noise_is_a_share_of_the_range():
    n, share = 2_000, 0.05
    env = make_env(num_envs=n, num_rays=1, perturbation=Perturbation(velocity_noise=share))
    # A command in the middle of the range, ten standard deviations from its limits.
    _drive(env, env.reset(), (0.25, 0.0), 1)
    executed = torch.from_numpy(env.batch.ctrl[:, :2].copy())
    noise = (executed - torch.tensor([0.25, 0.0])) / torch.tensor([0.5, 2 * math.pi])
    assert (noise.mean(0).abs() < 5 * share / math.sqrt(n)).all()
    assert ((noise.std(0) / share - 1).abs() < 5 / math.sqrt(2 * n)).all()
    assert abs(np.corrcoef(noise.T.numpy())[0, 1]) < 5 / math.sqrt(n)
    # At the limits it stays within them.
    _drive(env, env.reset(), (0.5, math.pi), 1)
    executed = torch.from_numpy(env.batch.ctrl[:, :2].copy())
    assert (executed <= torch.tensor([0.5, math.pi], dtype=F64)).all() and executed[
        :, 0
    ].min() < 0.5


@pytest.mark.parametrize(
    "kwargs",
    [{"range_noise": 0.1}, {"dropout": 0.2}, {"velocity_noise": 0.1}, {"latency": 1}],
    ids=lambda kwargs: next(iter(kwargs)),
)
def test_faults_leave_the_scenes_of_a_seed_unchanged(kwargs):
    clean, faulty = make_env(num_envs=4), make_env(num_envs=4, perturbation=Perturbation(**kwargs))
    for _ in range(3):
        starts = [env.reset() for env in (clean, faulty)]
        for key in ("pose", "human_pose", ("scene", "goal"), ("scene", "boxes")):
            assert torch.equal(starts[0][key], starts[1][key])
        for env, start in zip((clean, faulty), starts):
            _drive(env, start, (0.3, 0.1), 2)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"range_noise": -0.1}, "Noise must not be negative"),
        ({"velocity_noise": -0.1}, "Noise must not be negative"),
        ({"range_noise": math.nan}, "Noise must not be negative"),
        ({"dropout": 1.5}, r"probability in \[0, 1\], got 1.5"),
        ({"dropout": -0.5}, r"probability in \[0, 1\], got -0.5"),
        ({"latency": 2}, "latency must be 0 or 1 control steps, got 2"),
    ],
)
def test_faults_are_checked(kwargs, message):
    with pytest.raises(ValueError, match=message):
        Perturbation(**kwargs)


@pytest.mark.parametrize("name", ["goal_radius", "num_rays", "max_range"])
@pytest.mark.parametrize("value", [0, -1, math.nan])
def test_sizes_are_checked(name, value):
    with pytest.raises(ValueError, match=f"{name} must be positive, got {value}"):
        NavigationEnv(**{name: value})
