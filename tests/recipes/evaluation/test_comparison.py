"""Drives that were shown beside those of a policy, against numbers worked out by hand."""

from __future__ import annotations

import pytest
import torch

from recipes.evaluation.comparison import Comparison, draw, table
from recipes.evaluation.style import Drives


def past(*sides: float) -> Drives:
    """Straight drives past the human, at these distances to the left."""
    x = torch.tensor([-2.0, 0.0, 2.0])
    paths = [torch.stack((x, torch.full_like(x, side)), -1) for side in sides]
    return Drives(torch.stack(paths), torch.ones(len(sides), 3, dtype=torch.bool))


@pytest.fixture
def comparison() -> Comparison:
    """Shown 1 m to the right; at demo = 1 three of four pass there, 1.5 m away, without boxes all do."""
    driven = {"demo": past(-1.5, -1.5, -1.5, 1.5), "efficiency": past(0.5, 0.5)}
    free = {"demo": past(-1.0, -1.0), "efficiency": past(1.0, 1.0)}
    return Comparison(past(-1.0, -1.0), driven, free, {"demo": 1.0, "efficiency": 0.5})


def test_numbers_are_those_of_the_drives(comparison):
    numbers = comparison.numbers()
    assert comparison.likeness == 0.75
    assert numbers["shown"] == {"passes on the right": 1.0, "nearest to the human / m": 1.0}
    assert numbers["demo"] == pytest.approx(
        {
            "success": 1.0,
            "passes on the right": 0.75,
            "passes on the right, without boxes": 1.0,
            "nearest to the human / m": 1.5,
            # Three times 0.5 m and once 2.5 m.
            "distance to what was shown / m": 1.0,
            "distance to what was shown, without boxes / m": 0.0,
        }
    )
    assert numbers["efficiency"]["distance to what was shown, without boxes / m"] == 2.0
    assert table(numbers).splitlines()[1].startswith("        demo: success 100 %; passes on the r")


def test_it_is_drawn(comparison, tmp_path):
    draw(tmp_path / "style.png", comparison)
    assert (tmp_path / "style.png").stat().st_size > 10_000
