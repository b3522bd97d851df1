"""The navigation task: rewards and ends of episodes, against closed forms."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict

from envs import HSR, HUMAN_RADIUS, TURTLEBOT2, NavigationEnv
from tests._navigation import F64, drive, make_env, place, random_drive

# --- rewards -----------------------------------------------------------------------------------


def test_the_core_reward_telescopes_to_the_distance_gained():
    env = make_env(num_envs=8, scene="empty")
    start = env.reset()
    steps = random_drive(env, start, 20)
    assert not steps["terminated"].any()
    gained = start["goal"][:, 0] - steps["goal"][:, -1, 0]
    assert gained.abs().max() > 0.1
    torch.testing.assert_close(steps["reward"][..., 0].sum(-1), 125 * gained)


def test_driving_towards_the_goal_pays_and_away_costs():
    env = make_env(scene="empty")
    reward = []
    for heading in (0.0, math.pi):
        start = place(env, (0, 0, heading), goal=(9, 0), human=(4, 9, 0))
        # From the third step on the robot drives at 0.5 m/s: 0.1 m a step.
        reward.append(drive(env, start, (0.5, 0.0), 5)["reward"][0, 3:, 0])
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
        start = place(env, (1, 2, 0.3), goal=(9, 9), human=human)
        reward = drive(env, start, (0.0, 0.0), 1)["reward"][0, 0]
        expected = torch.tensor([0.0, penalty, -10.0], dtype=F64)
        torch.testing.assert_close(reward, expected, rtol=0, atol=1e-9)


def test_the_penalty_counts_the_distance_after_the_step():
    env = make_env(scene="moving_human", num_envs=4)
    steps = random_drive(env, place(env, (6, 0, 0), human=(8, 0, math.pi)), 15)
    distance = (steps["pose"][..., :2] - steps["human_pose"][..., :2]).norm(dim=-1)
    assert (distance < 2).any()
    expected = -10 * ((2 - distance).clamp_min(0) / 1.7) ** 2
    torch.testing.assert_close(steps["reward"][..., 1], expected)


def test_every_step_costs_ten():
    env = make_env(num_envs=4)
    assert (random_drive(env, env.reset(), 10)["reward"][..., 2] == -10).all()


# --- ends of episodes --------------------------------------------------------------------------


def _until_done(env: NavigationEnv, current: TensorDict, action=(0.5, 0.0)) -> TensorDict:
    steps = drive(env, current, action, 60)
    end = int(steps["done"][0, :, 0].int().argmax())
    assert steps["done"][0, end].all()
    return steps[0, : end + 1]


def _flags(step: TensorDict) -> list[bool]:
    keys = ("success", "collision_human", "collision_obstacle", "terminated", "truncated")
    return [bool(step[key]) for key in keys]


def test_driving_into_the_human():
    env = make_env(scene="empty")
    steps = _until_done(env, place(env, (0, 0, 0), goal=(9, 0), human=(2, 0.1, 0)))
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
    start = place(env, (0, 0, 0), goal=(9, 0), human=(5, 3, 0), boxes=boxes)
    steps = _until_done(env, start)
    assert steps["pose"][-1, 0] >= 1.5 - TURTLEBOT2.radius > steps["pose"][-2, 0]
    assert _flags(steps[-1]) == [False, False, True, True, False]
    assert steps["reward"][-1, 0] < -900


@pytest.mark.parametrize("goal_radius", [0.3, 0.6])
def test_reaching_the_goal(goal_radius):
    env = make_env(scene="empty", goal_radius=goal_radius)
    steps = _until_done(env, place(env, (0, 0, 0), goal=(2, 0), human=(0, 5, 0)))
    distance = steps["goal"][:, 0]
    assert distance[-1] <= goal_radius < distance[-2]
    assert _flags(steps[-1]) == [True, False, False, True, False]
    assert (steps["reward"][:, 0] > 0).all()


def test_a_collision_in_the_step_that_reaches_the_goal_is_no_success():
    env = make_env(scene="empty", goal_radius=0.43)
    steps = _until_done(env, place(env, (0, 0, 0), goal=(2, 0), human=(2, 0, 0)))
    assert steps["goal"][-1, 0] <= TURTLEBOT2.radius + HUMAN_RADIUS and steps["goal"][-2, 0] > 0.43
    assert _flags(steps[-1]) == [False, True, False, True, False]


def test_truncation_after_300_steps():
    env = make_env(num_rays=1)
    steps = drive(env, env.reset(), (0.0, 0.0), 300)
    assert not steps["done"][:, :299].any()
    assert _flags(steps[0, 299]) == [False, False, False, False, True]


def test_an_episode_that_ends_in_its_last_step_is_terminated_not_truncated():
    start = {"pose": (0, 0, 0), "goal": (9, 0), "human": (1, 0, 0)}
    env = make_env(scene="empty")
    length = len(_until_done(env, place(env, **start)))
    env = make_env(scene="empty", max_episode_steps=length)
    steps = _until_done(env, place(env, **start))
    assert len(steps) == length and _flags(steps[-1]) == [False, True, False, True, False]


@pytest.mark.parametrize("scene", ["static", "corridor", "moving_human", "empty"])
def test_causes_exclude_each_other_and_make_up_termination(scene):
    env = make_env(num_envs=256, scene=scene, num_rays=1)
    start = env.reset()
    # Start all over the scene, in collisions and goals too.
    unit = torch.rand(256, 2, dtype=F64)
    start["qpos"][:, :2] = start["scene", "goal"] * unit[:, :1] + 2 * unit - 1
    steps = random_drive(env, env.reset(start, set_state=True), 12)
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
    # A second simulation takes the same steps one by one, and MuJoCo looks for contacts after each.
    twin = make_env(num_envs=1_000, robot=robot, num_rays=1)
    twin.reset(start, set_state=True)
    contacts = twin.batch.bind("ncon")
    seen, driving = torch.zeros(2, dtype=torch.int64), torch.ones(1_000, dtype=torch.bool)
    for _ in range(8):
        before = env.batch.state.copy()
        current = env.step(current.set("action", env.action_spec.rand()))["next"]
        twin.batch.state[...] = before
        twin._view["ctrl"].copy_(env._view["ctrl"])
        touching = torch.zeros(1_000, dtype=torch.bool)
        for _ in range(env.frame_skip):
            twin.batch.step(nstep=1)
            twin.batch.forward()
            touching |= torch.from_numpy(contacts > 0).reshape(-1)
        flagged = (current["collision_human"] | current["collision_obstacle"]).squeeze(-1)
        # An episode ends with its first contact. Who overlaps with something is flung away by it.
        assert torch.equal(flagged[driving], touching[driving])
        seen += torch.stack((flagged[driving], ~flagged[driving])).long().sum(-1)
        driving &= ~touching
    assert (seen > 100).all()
