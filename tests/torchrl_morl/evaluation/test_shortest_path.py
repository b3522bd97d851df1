"""Shortest ways in closed form: straight, around a circle, around a corner, and none at all."""

from __future__ import annotations

import math

import pytest
import torch

from envs import HUMAN_RADIUS, SCENES
from torchrl_morl.evaluation.shortest_path import shortest_path_length
from torchrl_morl.geometry import point_box_distance

START, GOAL = torch.tensor([[0.0, 0.0]]), torch.tensor([[4.0, 0.0]])
NOTHING = torch.zeros(1, 0, 5)


def box(*values: float) -> torch.Tensor:
    return torch.tensor([[values]])


def test_nothing_in_the_way():
    free = shortest_path_length(START, GOAL, NOTHING, radius=0.2, goal_radius=0.3)
    assert free.item() == pytest.approx(3.7)
    beside = shortest_path_length(START, GOAL, box(2.0, 0.5, 0.0, 0.3, 0.29), radius=0.2)
    assert beside.item() == pytest.approx(4.0)


def test_around_a_human():
    """Two tangents and the arc between them."""
    radius = 0.5 + 0.3
    length = shortest_path_length(
        START, GOAL, NOTHING, radius=0.3, human=torch.tensor([[2.0, 0.0, 1.0]]), human_radius=0.5
    ).item()
    tangent = math.sqrt(4 - radius**2)
    exact = 2 * tangent + radius * (math.pi - 2 * math.acos(radius / 2))
    assert exact <= length <= exact + 0.01


def test_around_the_corners_of_a_box():
    """Straight to the first corner, along the side, and straight on; both corners are round."""
    length = shortest_path_length(START, GOAL, box(2.0, 0.0, 0.0, 1.0, 0.5), radius=0.1).item()
    # From (0, 0) tangentially to the circle of 0.1 m around (1, 0.5), and around it.
    to_corner = math.hypot(1.0, 0.5)
    bend = math.atan2(0.5, 1.0) + math.asin(0.1 / to_corner)
    exact = 2 * (math.sqrt(to_corner**2 - 0.01) + 0.1 * bend) + 2.0
    assert exact <= length <= exact + 0.005
    # Turned by a quarter and exchanged sides: the same box.
    turned = shortest_path_length(START, GOAL, box(2.0, 0.0, math.pi / 2, 0.5, 1.0), radius=0.1)
    assert turned.item() == pytest.approx(length)


def test_the_shorter_side_is_taken():
    length = shortest_path_length(START, GOAL, box(2.0, 1.0, 0.0, 0.01, 1.5), radius=0.01).item()
    assert length == pytest.approx(2 * math.hypot(2.0, 0.5), abs=0.02)


def test_no_way():
    """Four walls around the start."""
    walls = torch.tensor(
        [
            [
                [1.0, 0.0, 0.0, 0.1, 1.0],
                [-1.0, 0.0, 0.0, 0.1, 1.0],
                [0.0, 1.0, 0.0, 1.0, 0.1],
                [0.0, -1.0, 0.0, 1.0, 0.1],
            ]
        ]
    )
    assert shortest_path_length(START, GOAL, walls, radius=0.2).isnan()


@pytest.mark.parametrize("name", ["static", "corridor"])
def test_every_scene_has_a_way(name):
    scene = SCENES[name].sample(8, 0.177, torch.Generator().manual_seed(0))
    human = scene["human"]
    length = shortest_path_length(
        scene["start"],
        scene["goal"],
        scene["boxes"],
        radius=0.177,
        human=human,
        human_radius=HUMAN_RADIUS,
    )
    straight = (scene["goal"] - scene["start"][:, :2]).norm(dim=-1)
    assert (length >= straight - 1e-9).all() and (length < 1.6 * straight).all()
    share = torch.linspace(0, 1, 400)[:, None, None]
    points = scene["start"][:, :2] + share * (scene["goal"] - scene["start"][:, :2])
    clear = (point_box_distance(points[:, :, None], scene["boxes"]) > 0.177).all(-1).all(0)
    clear &= ((points - human[:, :2]).norm(dim=-1) > 0.177 + HUMAN_RADIUS).all(0)
    torch.testing.assert_close(length[clear], straight[clear])
    assert (length[~clear] > straight[~clear]).all() and (~clear).any()


def test_a_robot_has_a_size():
    with pytest.raises(ValueError, match="radius must be positive, got 0"):
        shortest_path_length(START, GOAL, NOTHING, radius=0)
