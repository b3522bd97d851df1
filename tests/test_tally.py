"""The counts that the regression tests are made of."""

from __future__ import annotations

import pytest
import torch

from tests._tally import count, counted, python_calls

pytestmark = pytest.mark.benchmark


def test_tally_sees_every_way_to_wait():
    x = torch.arange(3.0)
    ways = (
        x[0].item,
        x.tolist,
        x.numpy,
        (x > 1).nonzero,
        lambda: bool(x.any()),
        lambda: float(x.sum()),
        lambda: x[x > 1],
        lambda: x.masked_select(x > 1),
        lambda: torch.where(x > 1),
        lambda: torch.equal(x, x),
        lambda: x.unique(),
    )
    for way in ways:
        with counted() as tally:
            way()
        assert len(tally.waits) == 1, way
    with counted() as tally:
        torch.where(x > 1, x, -x)[torch.tensor([0, 2])].sum()
    assert not tally.waits
    # The index, a constant, is no new tensor.
    assert (tally.total, tally.allocations) == (6, 5)


def test_tally_sees_a_loop():
    x = torch.rand(8, 3)

    def looped() -> torch.Tensor:
        return torch.stack([row + 1 for row in x])

    assert count(looped).total > count(lambda: x + 1).total + 8
    assert python_calls(lambda: [abs(value) for value in range(50)]) >= 50
