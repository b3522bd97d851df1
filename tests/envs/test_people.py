"""People in numbers: where they are when, and what each kind of them does."""

from __future__ import annotations

import math

import pytest
import torch

from envs.people import (
    FAR,
    absent,
    ahead,
    any_of,
    crossing,
    nobody,
    overtaking,
    place_at,
    standing,
    standing_up,
    towards,
)

WAY = torch.full((2000,), 9.0, dtype=torch.float64)


def drawn(person, seed: int = 0):
    return person(WAY, torch.Generator().manual_seed(seed))


def test_a_walk_in_closed_form():
    someone = torch.tensor([[1.0, 2.0, 0.0, 4.0, 6.0, 0.5, 3.0]], dtype=torch.float64)
    for time, place in ((0, (1, 2)), (3, (1, 2)), (5, (1.6, 2.8)), (13, (4, 6)), (99, (4, 6))):
        assert place_at(someone, float(time))[0].tolist() == pytest.approx(place)


def test_who_stands_stays_and_nobody_is_not_there():
    rows = drawn(standing)
    assert torch.equal(place_at(rows, 30.0), rows[:, :2])
    assert not absent(rows).any() and absent(drawn(nobody)).all()
    assert (drawn(nobody)[:, :2].abs() >= FAR).all()


@pytest.mark.parametrize("person", [towards, crossing, ahead, overtaking, standing_up])
def test_everyone_walks_at_a_speed_of_the_range(person):
    speed = drawn(person((0.3, 0.8)))[:, 5]
    assert 0.3 <= speed.min() < 0.31 and 0.79 < speed.max() <= 0.8


def test_who_walks_towards_the_robot_passes_goal_and_start():
    rows = drawn(towards((0.5, 0.5)))
    assert (rows[:, 0] >= 9.0).all() and (rows[:, 3] <= -1.0).all()
    assert torch.equal(rows[:, 1], rows[:, 4])
    assert (rows[:, 2] == math.pi).all()


def test_who_crosses_is_on_the_way_about_when_the_robot_is():
    rows = drawn(crossing((0.25, 1.2)))
    left = rows[:, 1] > 0
    assert 0.45 < left.double().mean() < 0.55
    assert (rows[:, 1].sign() == -rows[:, 4].sign()).all()
    # Where the walk meets the x axis, and when, against half a metre a second to there.
    share = rows[:, 1] / (rows[:, 1] - rows[:, 4])
    meets = rows[:, 0] + share * (rows[:, 3] - rows[:, 0])
    length = share * (rows[:, 3:5] - rows[:, :2]).norm(dim=-1)
    late = rows[:, 6] + length / rows[:, 5] - meets / 0.5
    assert (meets > 0.25 * 9 - 1).all() and (meets < 0.75 * 9 + 1).all()
    # Two seconds either way, and what a slanted walk is longer and further.
    assert late.abs().max() < 7 and late.abs().median() < 1.5


def test_who_overtakes_starts_behind_and_who_is_ahead_before():
    behind, before = drawn(overtaking((0.6, 1.2))), drawn(ahead((0.25, 0.45)))
    assert (behind[:, 0] < -5).all() and (behind[:, 3] > 9).all()
    assert (before[:, 0] > 1).all() and (before[:, 3] > before[:, 0]).all()


def test_who_stands_up_waits_and_leaves():
    rows = drawn(standing_up((0.5, 0.5)))
    assert torch.equal(place_at(rows, 2.0), rows[:, :2])
    walked = (place_at(rows, 60.0) - rows[:, :2]).norm(dim=-1)
    assert walked.min() >= 3.0 - 1e-9 and walked.max() <= 5.0 + 1e-9


def test_any_of_draws_each():
    rows = drawn(any_of(standing, towards((0.5, 0.5))))
    assert 0.45 < (rows[:, 5] > 0).double().mean() < 0.55
