"""Ways around boxes: closed forms, and never where the exact search finds none."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from envs import scene_checks
from envs.ways import leads_around


def ask(*boxes, goal=(4.0, 0.0)) -> bool:
    rows = np.array([boxes], dtype=np.float64).reshape(1, -1, 5)
    return bool(leads_around(np.zeros((1, 2)), np.array([goal]), rows)[0])


def test_nothing_and_a_wall():
    assert ask()
    assert ask((2, 0, 0, 0.1, 3))
    assert ask((2, 0, 1.0, 0.1, 3))


@pytest.mark.parametrize("open_side", [None, 0, 1, 2, 3])
def test_a_room_without_a_door_holds_everything(open_side):
    walls = [(1, 0, 0, 0.1, 1.2), (-1, 0, 0, 0.1, 1.2), (0, 1, 0, 1.2, 0.1), (0, -1, 0, 1.2, 0.1)]
    kept = [wall for side, wall in enumerate(walls) if side != open_side]
    assert ask(*kept) == (open_side is not None)


def test_a_goal_in_a_box_is_not_reached():
    assert not ask((4, 0, 0.3, 0.5, 0.5))


def test_what_it_settles_is_what_the_exact_search_says(monkeypatch):
    generator = torch.Generator().manual_seed(0)
    unit = torch.rand(80, 5, 5, generator=generator).double()
    boxes = unit * torch.tensor([6.0, 4.0, 3.0, 1.2, 1.2]) - torch.tensor([0.0, 2.0, 0, 0, 0])
    start, goal = torch.zeros(80, 2).double(), torch.tensor([[6.0, 0.0]]).repeat(80, 1).double()
    grown = torch.full((80, 5), 0.2).double()
    found = scene_checks.way_exists(start, goal, boxes, grown)
    monkeypatch.setattr(scene_checks, "_free_way", scene_checks._round_way)
    assert torch.equal(found, scene_checks.way_exists(start, goal, boxes, grown))
    assert found.any() and not found.all()
