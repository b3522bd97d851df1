"""Distances to people and boxes beside those of torch, and beside each other."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from envs.contacts import box_gaps, gaps, near_rows
from torchrl_morl.geometry import point_box_distance


@pytest.fixture
def scene(num_envs: int = 200, people: int = 2, num_boxes: int = 3):
    """Robots, people and boxes anywhere: the arguments of the functions, by their names."""
    draw = np.random.default_rng(0)
    boxes = draw.uniform([-2, -2, -4, 0.1, 0.1], [2, 2, 4, 1, 1], (num_envs, num_boxes, 5))
    points = draw.uniform(-2, 2, (2, 1 + people + num_boxes, num_envs))
    points[:, 1 + people :] = boxes[..., :2].T
    cos, sin = np.cos(boxes[..., 2].T), np.sin(boxes[..., 2].T)
    position = draw.uniform(-2, 2, (num_envs, 2))
    return {"points": points, "position": position, "cos": cos, "sin": sin, "boxes": boxes}


def expected(scene, people: int = 2) -> np.ndarray:
    """The same of torch, ``[2, N]``."""
    place, boxes = torch.tensor(scene["position"])[:, None], torch.tensor(scene["boxes"])
    human = torch.tensor(scene["points"][:, 1 : 1 + people].T) - place
    box = point_box_distance(place.expand(-1, boxes.shape[1], -1), boxes).clamp_min(0.0)
    return torch.stack((human.norm(dim=-1).amin(-1), box.amin(-1))).numpy()


def test_gaps_are_those_of_torch(scene):
    found = gaps(**scene, rows=np.arange(200), people=2)
    np.testing.assert_allclose(found, expected(scene), atol=1e-12)
    assert (found[1] == 0).any() and (found[1] > 0).any()  # inside a box, and beside
    some = np.array([7, 3])
    of_some = gaps(**scene | {"position": scene["position"][some]}, rows=some, people=2)
    np.testing.assert_array_equal(of_some, found[:, some])


def test_what_ends_a_step_is_what_counts_within_it(scene):
    """To the last bit: a contact is one wherever it is looked for."""
    within = gaps(**scene, rows=np.arange(200), people=2)[1]
    way = scene["points"][:, 3:] - scene["position"].T[:, None]
    np.testing.assert_array_equal(box_gaps(way, scene["cos"], scene["sin"], scene["boxes"]), within)


def test_who_is_near_a_person_or_a_box(scene):
    hull = np.random.default_rng(1).uniform(0.1, 1.0, 200)
    person, box = expected(scene)
    rows = near_rows(**scene, people=2, human_radius=0.25, hull=hull)
    assert rows.tolist() == np.flatnonzero((person <= hull + 0.25) | (box <= hull)).tolist()
    assert 0 < len(rows) < 200


def test_nobody_and_no_boxes_are_far(scene):
    empty = {name: one[:0] for name, one in scene.items() if name in ("cos", "sin")}
    empty |= {"boxes": scene["boxes"][:, :0], "points": scene["points"][:, :1]}
    found = gaps(**scene | empty, rows=np.arange(200), people=0)
    assert (found == math.inf).all()
    way = scene["points"][:, :0]
    assert (box_gaps(way, empty["cos"], empty["sin"], empty["boxes"]) == math.inf).all()
