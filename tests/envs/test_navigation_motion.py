"""How robot and human move in the navigation task, and its faults, against closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from envs import HSR, TURTLEBOT2, Faults, NavigationEnv
from tests._navigation import F64, drive, make_env, place

# --- motion ------------------------------------------------------------------------------------


def _speeds(env, action, steps=10):
    """Measured forward speed and turn rate over the last second."""
    steps = drive(env, place(env, (0, 0, 0), goal=(9, 9), human=(0, 9, 0)), action, steps)
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
    start = place(env, pose, goal=(9, 9), human=(0, 9, 0))
    velocity = drive(env, start, (0.4, 1.5), 6)["qvel"]
    cos, sin = heading.cos()[:, None], heading.sin()[:, None]
    x, y = velocity[..., 0], velocity[..., 1]
    in_start_frame = torch.stack((cos * x + sin * y, cos * y - sin * x, velocity[..., 2]), dim=-1)
    torch.testing.assert_close(in_start_frame, in_start_frame[:1].expand_as(in_start_frame))


def test_0_95_of_the_command_is_reached_within_two_steps():
    env = make_env(scene="empty", num_rays=1)
    start = place(env, (0, 0, 0), goal=(9, 9), human=(0, 9, 0))
    velocity = drive(env, start, (0.5, 1.0), 2)["qvel"][0]
    assert velocity[1, :2].norm() > 0.475 and velocity[1, 2] > 0.95
    slow = make_env(scene="empty", num_rays=1, robot="hsr")
    start = place(slow, (0, 0, 0), goal=(9, 9), human=(0, 9, 0))
    assert drive(slow, start, (0.5, 1.0), 1)["qvel"][0, 0, 0] < 0.3


def test_actions_are_clamped():
    env, twin = (make_env(num_envs=3) for _ in range(2))
    wild = torch.tensor([[7.0, 9.0], [-3.0, -9.0], [0.2, 99.0]], dtype=F64)
    tame = torch.tensor([[0.5, math.pi], [0.0, -math.pi], [0.2, math.pi]], dtype=F64)
    first, second = (drive(e, e.reset(), a, 4) for e, a in ((env, wild), (twin, tame)))
    assert torch.equal(first["qpos"], second["qpos"])


@pytest.mark.parametrize("action", [(0.5, 0.0), (0.3, 0.6), (0.5, -0.3), (0.0, 2.0)])
@pytest.mark.parametrize("robot", ["turtlebot2", "hsr"])
def test_rolling_wheels_drive_like_the_planar_base(robot, action):
    moved = []
    for base in ("planar", "wheels"):
        env = make_env(scene="empty", drive=base, robot=robot, num_rays=1)
        # Three seconds to get going: wheels follow a turn later than the planar base.
        pose = drive(env, env.reset(), action, 30)["pose"][0, 15:]
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
        ctrl[:] = command, 0.0
        for _ in range(300):
            env.batch.step(nstep=1)
            speeds.append((velocity[0, :2] @ forward, velocity[0, wheel] * robot.wheel_radius))
    base, rim = np.array(speeds).T
    # It takes two time steps until the wheels press on the floor.
    assert np.abs(rim - base)[2:].max() < 0.02
    assert base[:300].max() < 0.505 and base[300:].min() > -0.005  # no overshoot
    assert base[299] == pytest.approx(0.5, abs=0.002) and abs(base[-1]) < 0.002


@pytest.mark.parametrize("robot", ["turtlebot2", "hsr"])
def test_wheels_turn_as_fast_as_the_planar_base(robot):
    turned = []
    for base in ("planar", "wheels"):
        env = make_env(scene="empty", drive=base, robot=robot, num_rays=1)
        start = env.reset()
        pose = drive(env, start.clone(), (0.0, 1.0), 5)["pose"][0, :, 2]
        turned.append((pose - start["pose"][0, 2]).remainder(2 * math.pi))
    # What torque and friction take away in the first step stays; with the same time constant no more
    # is lost.
    lost = turned[0] - turned[1]
    assert lost[0] < 0.04 and (lost - lost[0]).abs().max() < 0.01, lost


def test_wheels_start_hardly_later_than_the_planar_base():
    for robot in ("turtlebot2", "hsr"):
        distance = []
        for base in ("planar", "wheels"):
            env = make_env(scene="empty", drive=base, robot=robot, num_rays=1)
            start = env.reset()
            pose = drive(env, start.clone(), (0.5, 0.0), 5)["pose"][0, -1]
            distance.append(float((pose - start["pose"][0])[:2].norm()))
        # To 0.5 m/s at 3 m/s^2, what friction transmits: half of 0.5 m/s for a sixth of a second.
        # The integrators differ, which lets the slow robot gain half a millimetre.
        assert -0.001 < distance[0] - distance[1] < 0.042, robot


def test_the_human_walks_half_a_metre_a_second_and_stops():
    env = make_env(num_envs=8, scene="moving_human", num_rays=1)
    start = env.reset()
    target = start["scene", "human_goal"]
    length = (target - start["human_pose"][:, :2]).norm(dim=-1)
    steps = drive(env, start.clone(), (0.0, 0.0), 125)
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
    after = drive(standing, start.clone(), (0.0, 0.0), 3)
    assert torch.equal(after["human_pose"][:, -1], start["human_pose"])


# --- faults ------------------------------------------------------------------------------------


def _scans(**kwargs):
    clean = make_env(num_envs=64).reset()["scan"]
    faulty = make_env(num_envs=64, faults=Faults(**kwargs)).reset()["scan"]
    return clean, faulty


def test_faults_are_off_by_default():
    assert Faults() == Faults(0.0, 0.0, 0.0, 0) == NavigationEnv().faults
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
    late = make_env(num_envs=3, drive=drive, faults=Faults(latency=1))
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
    env = make_env(num_envs=n, num_rays=1, faults=Faults(velocity_noise=share))
    # A command in the middle of the range, ten standard deviations from its limits.
    drive(env, env.reset(), (0.25, 0.0), 1)
    executed = torch.from_numpy(env.batch.ctrl[:, :2].copy())
    noise = (executed - torch.tensor([0.25, 0.0])) / torch.tensor([0.5, 2 * math.pi])
    assert (noise.mean(0).abs() < 5 * share / math.sqrt(n)).all()
    assert ((noise.std(0) / share - 1).abs() < 5 / math.sqrt(2 * n)).all()
    assert abs(np.corrcoef(noise.T.numpy())[0, 1]) < 5 / math.sqrt(n)
    # At the limits it stays within them.
    drive(env, env.reset(), (0.5, math.pi), 1)
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
    clean, faulty = make_env(num_envs=4), make_env(num_envs=4, faults=Faults(**kwargs))
    for _ in range(3):
        starts = [env.reset() for env in (clean, faulty)]
        for key in ("pose", "human_pose", ("scene", "goal"), ("scene", "boxes")):
            assert torch.equal(starts[0][key], starts[1][key])
        for env, start in zip((clean, faulty), starts):
            drive(env, start, (0.3, 0.1), 2)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"range_noise": -0.1}, "range_noise must not be negative"),
        ({"velocity_noise": -0.1}, "velocity_noise must not be negative"),
        ({"range_noise": math.nan}, "range_noise must be a number or a pair"),
        ({"dropout": 1.5}, r"probability in \[0, 1\], got 1.5"),
        ({"dropout": -0.5}, r"probability in \[0, 1\], got -0.5"),
        ({"latency": 4}, "latency must be 0 to 3 control steps, got 4"),
    ],
)
def test_faults_are_checked(kwargs, message):
    with pytest.raises(ValueError, match=message):
        Faults(**kwargs)


@pytest.mark.parametrize("name", ["goal_radius", "max_range"])
@pytest.mark.parametrize("value", [0, -1, math.nan, math.inf, "4"])
def test_sizes_are_checked(name, value):
    with pytest.raises(ValueError, match=f"{name} must be positive, got {value!r}"):
        NavigationEnv(**{name: value})


@pytest.mark.parametrize("name", ["num_rays", "num_envs", "max_episode_steps"])
@pytest.mark.parametrize(
    ("value", "allowed"),
    [
        (0, "at least 1"),
        (-1, "at least 1"),
        (math.nan, "a whole number, at least 1"),
        (1.5, "a whole number, at least 1"),
        ("9", "a whole number, at least 1"),
        (True, "a whole number, at least 1"),
    ],
)
def test_counts_are_checked(name, value, allowed):
    with pytest.raises(ValueError, match=f"{name} must be {allowed}, got {value!r}"):
        NavigationEnv(**{name: value})


@pytest.mark.parametrize("dtype", [torch.int32, torch.bool, "float32"])
def test_observations_are_of_a_floating_point_type(dtype):
    with pytest.raises(ValueError, match="dtype must be a floating point one of PyTorch, got"):
        NavigationEnv(dtype=dtype)


@pytest.mark.parametrize("shape", [(2, 1), (2,), (2, 3), (1, 2), ()])
def test_an_action_of_another_shape_drives_nobody(shape):
    """Broadcast, one number would be every robot's speed and turn rate."""
    env = NavigationEnv(num_envs=2, seed=0)
    state = env.reset()
    before = env.simulation_state()["rows"]
    # Past the checks of a tensordict, as compiled and wrapped environments call it.
    batch = [] if shape[:1] != (2,) else [2]
    data = TensorDict(action=torch.full(shape, 0.3), batch_size=batch)
    with pytest.raises(ValueError, match=r"The action must have shape \[2, 2\], got \["):
        env._step(data)
    with pytest.raises(ValueError, match=r"must have shape \[2, 2\], there is none"):
        env.step(state)
    assert (env.simulation_state()["rows"] == before).all()
