"""Scenes with people who walk can be solved: by a planner in space and time that shares nothing with envs."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from envs import HUMAN_RADIUS, SCENES
from envs.catalogue import MET
from envs.encounters import solvable_among_people

RADIUS = 0.177
SPEED, LIMIT = 0.5, 60.0


def arrives(scene, cell: float = 0.15, radius: float = RADIUS) -> bool:
    """Whether a disc that moves along the axes of a grid, or waits, gets to the goal. "Yes" is proof.

    A cell is free where its centre keeps the radius and half a cell from everything, and from everyone
    between two times: moves between neighbouring centres are then free.
    """
    start, goal = scene["start"].numpy(), scene["goal"].numpy()
    boxes, people = scene["boxes"].numpy(), scene["people"].numpy()
    low = np.minimum(start[:2], goal) - 3.0
    shape = np.ceil((np.maximum(start[:2], goal) + 3.0 - low) / cell).astype(int) + 1
    x, y = np.meshgrid(*(low[i] + cell * np.arange(shape[i]) for i in (0, 1)), indexing="ij")
    margin = radius + cell / 2
    free = np.ones(shape, dtype=bool)
    for bx, by, yaw, half, width in boxes:
        cos, sin = math.cos(yaw), math.sin(yaw)
        along = np.maximum(abs(cos * (x - bx) + sin * (y - by)) - half, 0)
        across = np.maximum(abs(cos * (y - by) - sin * (x - bx)) - width, 0)
        free &= np.hypot(along, across) > margin
    step = cell / SPEED
    reached = np.hypot(x - start[0], y - start[1]) <= cell
    target = np.hypot(x - goal[0], y - goal[1]) <= 0.3
    for k in range(int(LIMIT / step)):
        clear = free.copy()
        for px, py, _, gx, gy, speed, out in people:
            length = math.hypot(gx - px, gy - py)
            ends = [speed * max(time - out, 0.0) for time in (k * step, (k + 1) * step)]
            for share in np.linspace(*ends, 4):
                part = min(share / max(length, 1e-9), 1.0)
                px_t, py_t = px + part * (gx - px), py + part * (gy - py)
                clear &= np.hypot(x - px_t, y - py_t) > margin + HUMAN_RADIUS
        # The first second is for turning.
        grown = reached.copy()
        if k * step >= 1.0:
            grown[1:] |= reached[:-1]
            grown[:-1] |= reached[1:]
            grown[:, 1:] |= reached[:, :-1]
            grown[:, :-1] |= reached[:, 1:]
        reached = grown & clear
        if (reached & target).any():
            return True
    return False


def described(people, boxes=(), goal=8.0) -> TensorDict:
    boxes = torch.tensor(boxes, dtype=torch.float64).reshape(1, -1, 5)
    return TensorDict(
        {
            "start": torch.zeros(1, 3, dtype=torch.float64),
            "goal": torch.tensor([[goal, 0.0]], dtype=torch.float64),
            "people": torch.tensor([people], dtype=torch.float64),
            "boxes": boxes,
        },
        batch_size=[1],
    )


def corridor(half: float) -> list[list[float]]:
    return [[4.0, sign * (half + 0.1), 0.0, 12.0, 0.1] for sign in (1, -1)]


APPROACH = [9.0, 0.0, math.pi, -3.0, 0.0, 0.5, 0.0]


def test_the_planner_itself_tells_a_trap_from_a_way():
    for half, way in ((1.4, True), (0.5, False)):
        assert arrives(described([APPROACH], corridor(half))[0]) is way


def test_in_a_narrow_corridor_nobody_passes_who_walks_towards_the_robot():
    assert solvable_among_people(described([APPROACH], corridor(1.6)), RADIUS).all()
    assert not solvable_among_people(described([APPROACH], corridor(0.5)), RADIUS).any()


def room(half: float) -> list[list[float]]:
    """Closed on all sides, from -1 m to 10 m, and that wide to either side."""
    ends = [[x, 0.0, math.pi / 2, half + 0.3, 0.1] for x in (-1.1, 10.1)]
    return [*ends, *([4.5, sign * (half + 0.1), 0.0, 6.0, 0.1] for sign in (1, -1))]


def test_who_stays_in_the_door_closes_it():
    wall = [[4.0, sign * 1.7, math.pi / 2, 1.3, 0.1] for sign in (1, -1)]
    stays = [4.0, 0.0, 0.0, 4.0, 0.0, 0.0, 0.0]
    leaves = [4.0, 0.0, 0.0, 7.0, 2.0, 0.5, 5.0]
    assert not solvable_among_people(described([stays], room(3.0) + wall), RADIUS).any()
    assert solvable_among_people(described([leaves], room(3.0) + wall), RADIUS).all()


def test_two_who_stand_side_by_side_close_a_narrow_room():
    stand = [[4.0, y, 0.0, 4.0, y, 0.0, 0.0] for y in (-0.3, 0.3)]
    assert solvable_among_people(described(stand, room(2.0)), RADIUS).all()
    assert not solvable_among_people(described(stand, room(0.9)), RADIUS).any()


@pytest.mark.parametrize("name", sorted(MET))
def test_every_scene_can_be_solved_in_space_and_time(name):
    scenes = SCENES[name].sample(6, RADIUS, torch.Generator().manual_seed(5))
    assert solvable_among_people(scenes, RADIUS).all()
    # Coarse cells close doors that are wide enough.
    assert all(arrives(scene) or arrives(scene, cell=0.07) for scene in scenes)
