"""The navigation task in numbers, against hand-made cases and the distances of envs.geometry."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from envs import HUMAN_RADIUS
from envs.navigation_task import NavigationTask
from torchrl_morl.geometry import point_box_distance

ROBOT_RADIUS, GOAL_RADIUS = 0.2, 0.3


def make_task(num_envs: int, num_boxes: int = 0) -> NavigationTask:
    """Goal, human and boxes are far away."""
    task = NavigationTask(num_envs, num_boxes, robot_radius=ROBOT_RADIUS, goal_radius=GOAL_RADIUS)
    task.goal[:], task.human_pose[:, :2], task.boxes[..., :2] = 30.0, -30.0, 60.0
    return task


def start(task: NavigationTask, position) -> np.ndarray:
    position = np.zeros_like(task.goal) + position
    task.begin(np.arange(len(position)), position)
    return position


@pytest.mark.parametrize("num_boxes", [1, 3])
def test_a_box_is_hit_at_the_distance_of_the_robots_radius(num_boxes):
    rng = np.random.default_rng(0)
    task = make_task(2000, num_boxes)
    task.boxes[..., :2] = rng.uniform(-1.5, 1.5, (2000, num_boxes, 2))
    task.boxes[..., 2] = rng.uniform(-math.pi, math.pi, (2000, num_boxes))
    task.boxes[..., 3:] = rng.uniform(0.05, 1.0, (2000, num_boxes, 2))
    position = start(task, rng.uniform(-1.5, 1.5, (2000, 2)))
    distance = point_box_distance(
        torch.from_numpy(position)[:, None], torch.from_numpy(task.boxes)
    ).amin(1)
    expected = (distance <= ROBOT_RADIUS).numpy()
    assert 300 < expected.sum() < 1900
    assert np.array_equal(task.end()[:, 0], expected)
    assert np.array_equal(task.flags, expected[:, None] & [False, False, True])
    # A circle around each box, and around the human.
    corners = np.hypot(task.boxes[..., 3], task.boxes[..., 4])
    np.testing.assert_allclose(task.radius[1:].T, corners)
    assert (task.radius[0] == HUMAN_RADIUS).all()


def test_the_causes_in_order():
    task = make_task(4)
    # Nothing, the goal, the human, both at once: a collision is no success.
    task.goal[1] = task.goal[3] = (GOAL_RADIUS, 0.0)
    task.human_pose[2:, :2] = (0.0, ROBOT_RADIUS + HUMAN_RADIUS)
    start(task, (0.0, 0.0))
    assert task.end().tolist() == [[False], [True], [True], [True]]
    assert task.flags.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 1, 0]]
    task.begin(np.array([1, 2]), np.zeros((4, 2)))
    assert task.flags.any(1).tolist() == [False, False, False, True]


def test_rewards_by_hand():
    task = make_task(3)
    task.goal[:] = (10.0, 0.0)
    task.human_pose[1, :2] = (0.5, 1.15)
    task.human_pose[2, :2] = (0.5, 0.1)
    before = start(task, (0.0, 0.0))
    task.locate(before + np.array([0.5, 0.0]))
    task.end()
    expected = [[62.5, 0, -10], [62.5, -10 * 0.5**2, -10], [-937.5, -10 * (1.9 / 1.7) ** 2, -10]]
    np.testing.assert_allclose(task.reward(before), expected, rtol=0, atol=1e-9)


def test_humans_walk_to_their_goals_and_stop():
    task = make_task(3)
    task.human_pose[:] = (0.0, 0.0, 1.0)
    task.human_goal[:] = [(3.0, 4.0), (0.06, 0.08), (0.0, 0.0)]
    start(task, (0.0, -1.0))
    task.people[..., 5] = 2.5
    task.walk(0.2, np.zeros(3))
    np.testing.assert_allclose(task.human_pose, [(0.3, 0.4, 1), (0.06, 0.08, 1), (0, 0, 1)])
    task.locate(np.array([[0.3, 0.0]] * 3))
    np.testing.assert_allclose(task.distance[1], [0.4, math.hypot(0.24, 0.08), 0.3])


def test_everything_is_seen_from_the_robots_frame():
    task = make_task(3, num_boxes=1)
    task.goal[:], task.human_pose[:, :2], task.boxes[..., :2] = (1.0, 0.0), (0.0, 2.0), (-3.0, 0.0)
    start(task, (0.0, 0.0))
    # Heading along x, along y, and backwards.
    cos, sin = np.array([1.0, 0.0, -1.0]), np.array([0.0, 1.0, 0.0])
    ahead, left = task.ahead_and_left(cos, sin)
    assert ahead.T.tolist() == [[1, 0, -3], [0, 2, 0], [-1, 0, 3]]
    assert left.T.tolist() == [[0, 2, 0], [-1, 0, 3], [0, -2, 0]]
    assert task.distance.T.tolist() == [[1, 2]] * 3
    rows = np.array([0, 2])
    some = task.ahead_and_left(cos[rows], sin[rows], rows)
    assert np.array_equal(some, np.stack((ahead, left))[..., rows])
