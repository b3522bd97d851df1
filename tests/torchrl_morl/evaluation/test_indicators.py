"""Hypervolume and expected utility in closed form."""

from __future__ import annotations

import math

import pytest
import torch

from torchrl_morl.evaluation import expected_utility, hypervolume, non_dominated, sparsity

POINTS = torch.tensor([[1.0, 3.0], [2.0, 2.0], [3.0, 1.0]])


def test_staircase():
    """Unit squares under a staircase: 3 + 2 + 1."""
    assert hypervolume(POINTS, torch.zeros(2)) == 6.0
    assert hypervolume(POINTS, torch.tensor([1.0, 1.0])) == 1.0
    assert hypervolume(10 * POINTS, torch.zeros(2)) == 600.0


def test_dominated_points_add_nothing():
    more = torch.cat([POINTS, torch.tensor([[1.0, 1.0], [-5.0, 100.0]])])
    assert hypervolume(more, torch.zeros(2)) == 6.0
    assert hypervolume(-POINTS, torch.zeros(2)) == 0.0


def test_box_in_three_dimensions():
    assert hypervolume(torch.tensor([[2.0, 3.0, 4.0]]), torch.ones(3)) == 6.0


def test_against_counting():
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(8, 3, generator=generator, dtype=torch.float64)
    samples = torch.rand(200_000, 1, 3, generator=generator, dtype=torch.float64)
    share = (samples <= points).all(-1).any(-1).double().mean().item()
    assert hypervolume(points, torch.zeros(3)) == pytest.approx(share, abs=0.004)


def test_utility_of_the_best_and_of_what_was_asked_for():
    weights = torch.tensor([[1.0, 0.0], [0.5, 0.5], [0.0, 1.0]])
    assert expected_utility(weights, POINTS) == pytest.approx((3 + 2 + 3) / 3)
    assert expected_utility(weights, POINTS, choice="commanded") == pytest.approx((1 + 2 + 1) / 3)
    assert expected_utility(weights, POINTS.flip(0), choice="commanded") == pytest.approx(8 / 3)
    assert expected_utility(weights, POINTS[:1]) == pytest.approx((1 + 2 + 3) / 3)


def test_undefined_values():
    broken = torch.tensor([[1.0, math.nan], [1.0, 1.0]])
    assert math.isnan(hypervolume(broken, torch.zeros(2)))
    assert math.isnan(expected_utility(torch.eye(2), broken))


def test_what_is_refused():
    with pytest.raises(ValueError, match=r"values must be \[P, K\] and reference \[K\]"):
        hypervolume(POINTS, torch.zeros(3))
    with pytest.raises(ValueError, match="weights and values"):
        expected_utility(torch.eye(3), POINTS)
    with pytest.raises(ValueError, match="weights and values"):
        expected_utility(torch.eye(2), POINTS, choice="commanded")
    with pytest.raises(ValueError, match="choice must be"):
        expected_utility(torch.eye(2), POINTS, choice="worst")


def test_what_no_point_dominates():
    points = torch.tensor([[3.0, 0.0], [2.0, 2.0], [1.0, 2.0], [0.0, 3.0], [2.0, 2.0]])
    assert non_dominated(points).tolist() == [True, True, False, True, False]
    with pytest.raises(ValueError, match="without NaN"):
        non_dominated([[float("nan"), 1.0]])


def test_sparsity_by_hand_and_what_misleads():
    # Gaps of 1 and 2 in the first, of 2 and 1 in the second objective; the last point is dominated.
    points = torch.tensor([[0.0, 3.0], [1.0, 1.0], [3.0, 0.0], [0.0, 0.0]])
    assert sparsity(points) == (1 + 4 + 4 + 1) / 2
    # A policy that ignores its preference has the best value that there is.
    assert sparsity(torch.ones(5, 2)) == 0.0 < sparsity(points)
    low = torch.full((2,), -1.0)
    assert hypervolume(torch.ones(5, 2), low) == 4.0 < hypervolume(points, low) == 8.0
