"""People walk in the middle of a control step, and contacts are seen there."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict

from envs import HUMAN_RADIUS, NavigationEnv, Scene
from envs.people import place_at

HALL = {"start": [0, 0, 0], "goal": [9, 0]}


def make(people, num_envs: int = 1, **kwargs) -> NavigationEnv:
    scene = {**HALL, "people": people, **kwargs}
    return NavigationEnv(scene=scene, num_envs=num_envs, num_threads=1, seed=0)


def step(env, data, speed: float):
    action = torch.tensor([[speed, 0.0]]).repeat(env.num_envs, 1)
    return env.step(data.set("action", action))["next"]


def test_people_are_where_their_walk_says():
    person = {"at": [4, 3], "goal": [4, -3], "speed": 0.7, "sets_out": 0.5}
    env = make([person])
    data = env.reset()
    row = data["scene", "people"][0, 0].clone()
    for index in range(1, 40):
        data = step(env, data, 0.0)
        expected = place_at(row, 0.2 * index)
        assert data["human_pose"][0, :2].tolist() == pytest.approx(expected.tolist(), abs=1e-9)


def test_the_nearest_person_is_reported_and_both_are_seen():
    env = make([{"at": [5, 0]}, {"at": [0, 2]}])
    data = env.reset()
    assert data["human"][0].tolist() == pytest.approx([2.0, math.pi / 2], abs=1e-6)
    scan = data["scan"][0]
    assert scan[180].item() == pytest.approx(2.0 - HUMAN_RADIUS, abs=1e-6)
    # The other one is beyond 4 m, until the robot has come nearer.
    assert scan[0] == 4.0
    for _ in range(20):
        data = step(env, data, 0.5)
    ahead = 5.0 - data["pose"][0, 0].item()
    assert data["scan"][0, 0].item() == pytest.approx(ahead - HUMAN_RADIUS, abs=1e-5)


def test_who_is_touched_may_be_the_one_who_is_not_reported():
    env = make([{"at": [1.0, 0.2]}, {"at": [0.5, -3.0]}])
    data = env.reset()
    while not data["done"].any():
        data = step(env, data, 0.5)
    assert data["collision_human"].all() and not data["success"].any()


def test_who_walks_does_not_yield():
    env = make([{"at": [9.5, 0], "goal": [-3, 0], "speed": 1.0}])
    data = env.reset()
    steps = 0
    while not data["done"].any():
        data, steps = step(env, data, 0.0), steps + 1
    assert data["collision_human"].all()
    assert steps * 0.2 == pytest.approx(9.5 - 0.177 - HUMAN_RADIUS, abs=0.2)


def test_a_contact_in_the_middle_of_a_step_counts():
    """Somebody fast grazes the robot between two control steps, and is past at the end of it."""
    touch = 0.177 + HUMAN_RADIUS
    graze = touch - 0.004
    # 0.6 m a step: from 0.3 m before to 0.3 m behind, where the gap is open at both ends.
    row = torch.tensor([graze, 0.3, 0.0, graze, -4.0, 3.0, 0.0], dtype=torch.float64)

    def sample(n: int, robot_radius: float, generator: torch.Generator) -> TensorDict:
        fields = {
            "start": torch.zeros(n, 3, dtype=torch.float64),
            "goal": torch.tensor([9.0, 0.0], dtype=torch.float64).repeat(n, 1),
            "people": row.repeat(n, 1, 1),
            "boxes": torch.zeros(n, 0, 5, dtype=torch.float64),
        }
        return TensorDict(fields, batch_size=[n])

    env = NavigationEnv(scene=Scene("graze", 0, sample, 3.0, 1), num_threads=1, seed=0)
    data = env.reset()
    assert math.hypot(graze, 0.3) > touch
    after = step(env, data, 0.0)
    assert after["human_pose"][0, 1].item() == pytest.approx(-0.3)
    gap = (after["pose"][0, :2] - after["human_pose"][0, :2]).norm().item()
    assert gap > touch and after["collision_human"].all()


def test_who_looks_in_between_drives_the_same():
    """Robots near a box take four short steps, and the same step as those that take one."""
    env = NavigationEnv(scene="empty", num_envs=4, num_threads=1, seed=0)
    other = NavigationEnv(scene="empty", num_envs=4, num_threads=1, seed=0)
    other._substeps.reach = 100.0
    first, second = env.reset(), other.reset()
    for _ in range(20):
        first, second = step(env, first, 0.4), step(other, second, 0.4)
        assert torch.equal(first["pose"], second["pose"])
        assert torch.equal(first["qvel"], second["qvel"])
