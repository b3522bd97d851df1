"""Drives compared where the human is passed: closed forms."""

from __future__ import annotations

import math

import pytest
import torch

from recipes.evaluation.style import Drives, aligned
from torchrl_morl.geometry import rotate


def past(height: float, *, turn: float = 0.0, move: tuple[float, float] = (0.0, 0.0)) -> Drives:
    """From (0, 0) to (8, 0) past a human at (4, 0), through (4, height); all of it moved and turned."""
    points = torch.tensor([[0.0, 0.0], [2.0, height], [4.0, height], [6.0, height], [8.0, 0.0]])
    human = torch.tensor([4.0, 0.0])
    points, human = (
        rotate(part, torch.tensor(turn)) + torch.tensor(move) for part in (points, human)
    )
    mask = torch.ones(1, len(points), dtype=torch.bool)
    return aligned(points[None], mask, human[None], points[-1:])


@pytest.mark.parametrize(("height", "side"), [(1.0, "left"), (-1.5, "right")])
@pytest.mark.parametrize("turn", [0.0, 1.0, math.pi, -2.5])
def test_the_side_and_the_distance_do_not_depend_on_the_place(height, side, turn):
    drives = past(height, turn=turn, move=(3.0, -7.0))
    assert drives.side == side
    assert drives.on(side) == 1.0
    torch.testing.assert_close(drives.nearest, torch.tensor([abs(height)]))
    torch.testing.assert_close(
        drives.position[0, 2], torch.tensor([0.0, height]), atol=1e-5, rtol=0
    )


def test_likeness_is_the_distance_between_the_paths_near_the_human():
    shown = past(1.0)
    torch.testing.assert_close(
        past(1.0, turn=0.7).distance_to(shown), torch.zeros(1), atol=1e-5, rtol=0
    )
    # Two metres above the other while near, and further from it nowhere.
    torch.testing.assert_close(past(-1.0).distance_to(shown), torch.tensor([2.0]))


def test_the_most_similar_of_those_shown_counts():
    one, two = past(1.0), past(-1.5)
    shown = Drives(torch.cat((one.position, two.position)), torch.cat((one.mask, two.mask)))
    torch.testing.assert_close(past(-1.25).distance_to(shown), torch.tensor([0.25]))
    assert shown.on("left") == shown.on("right") == 0.5


def test_who_never_comes_near_has_no_likeness():
    assert past(50.0).distance_to(past(1.0)).isnan().all()
    assert past(1.0).distance_to(past(50.0)).isnan().all()


def test_points_that_do_not_count_are_not_seen():
    drives = past(1.0)
    point = torch.tensor([[[0.0, -0.1]]])
    longer = Drives(
        torch.cat((drives.position, point), dim=1),
        torch.cat((drives.mask, torch.zeros(1, 1, dtype=torch.bool)), dim=1),
    )
    assert longer.side == "left"
    torch.testing.assert_close(longer.nearest, torch.ones(1))
