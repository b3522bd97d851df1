from __future__ import annotations

import functools
import math

import pytest
import torch

from torchrl_morl.evaluation import discrete_frechet, resample_path


def oracle(a: list, b: list) -> float:
    """The recursive definition, one pair of points at a time."""

    @functools.cache
    def cell(i: int, j: int) -> float:
        distance = math.dist(a[i], b[j])
        ways = [(i - 1, j), (i - 1, j - 1), (i, j - 1)]
        ways = [cell(*way) for way in ways if min(way) >= 0]
        return max(distance, min(ways)) if ways else distance

    return cell(len(a) - 1, len(b) - 1)


def ones(*shape: int) -> torch.Tensor:
    return torch.ones(shape, dtype=torch.bool)


class TestFrechet:
    @pytest.mark.parametrize("sizes", [(9, 7), (5, 12), (1, 6), (6, 1), (1, 1)])
    def test_oracle(self, sizes):
        num_a, num_b = (torch.randint(1, size + 1, (20,)) for size in sizes)
        a, b = (torch.rand(20, size, 2, dtype=torch.double) for size in sizes)
        mask_a, mask_b = (
            torch.arange(size) < num[:, None] for size, num in zip(sizes, (num_a, num_b))
        )
        # Padding must not leak.
        a[~mask_a], b[~mask_b] = torch.nan, 1e6
        expected = [oracle(a[i, : num_a[i]].tolist(), b[i, : num_b[i]].tolist()) for i in range(20)]
        assert discrete_frechet(a, mask_a, b, mask_b).tolist() == pytest.approx(expected)

    def test_known_shapes(self):
        along = torch.linspace(0, 3, 31)
        line = torch.stack([along, torch.zeros(31)], -1)
        mask = ones(31)
        assert discrete_frechet(line, mask, line, mask) == 0
        parallel = line + torch.tensor([0.0, 0.7])
        assert discrete_frechet(line, mask, parallel, mask).item() == pytest.approx(0.7)
        # The man is at one end when the dog is at the other one.
        assert discrete_frechet(line, mask, line.flip(0), mask).item() == pytest.approx(3.0)
        circle = torch.stack([along.cos(), along.sin()], -1)
        wider = discrete_frechet(circle, mask, 2.5 * circle, mask)
        assert wider.item() == pytest.approx(1.5)

    def test_is_not_the_hausdorff_distance(self):
        # Both visit the same points, in a different order.
        there = torch.tensor([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [0.0, 0.0]])
        back = torch.tensor([[0.0, 0.0], [2.0, 0.0], [1.0, 0.0], [0.0, 0.0]])
        assert discrete_frechet(there, ones(4), back, ones(4)) == 1

    def test_is_symmetric(self):
        a, b = torch.rand(5, 8, 2), torch.rand(5, 6, 2)
        mask_a, mask_b = ones(5, 8), ones(5, 6)
        assert torch.equal(
            discrete_frechet(a, mask_a, b, mask_b), discrete_frechet(b, mask_b, a, mask_a)
        )

    def test_batches(self):
        a, b = torch.rand(2, 3, 8, 2), torch.rand(6, 2)
        mask_a, mask_b = torch.rand(2, 3, 8) < 0.7, ones(6)
        mask_a[..., 3] = True
        result = discrete_frechet(a, mask_a, b, mask_b)
        assert result.shape == (2, 3)
        for i in range(2):
            for j in range(3):
                # A gap in the mask is a point that was not seen.
                expected = oracle(a[i, j][mask_a[i, j]].tolist(), b.tolist())
                assert result[i, j].item() == pytest.approx(expected)

    def test_undefined(self):
        a = torch.rand(2, 4, 2)
        mask = torch.tensor([[True] * 4, [False] * 4])
        assert discrete_frechet(a, mask, a, ones(2, 4)).isnan().tolist() == [False, True]
        assert discrete_frechet(a, ones(2, 4), a, mask).isnan().tolist() == [False, True]

    def test_sampling_does_not_matter_after_resampling(self):
        dense, coarse = torch.linspace(0, 2, 201), torch.tensor([0.0, 0.3, 2.0])
        a = torch.stack([dense, torch.zeros(201)], -1)
        b = torch.stack([coarse, torch.full((3,), 0.5)], -1)
        assert discrete_frechet(a, ones(201), b, ones(3)) > 0.9
        a, b = resample_path(a, ones(201), 50), resample_path(b, ones(3), 50)
        assert discrete_frechet(a, ones(50), b, ones(50)).item() == pytest.approx(0.5)


class TestResample:
    def test_a_corner(self):
        path = torch.tensor([[0.0, 0.0], [0.1, 0.0], [0.1, 0.0], [1.0, 0.0], [1.0, 3.0]])
        points = resample_path(path, ones(5), 5)
        expected = torch.tensor([[0.0, 0], [1, 0], [1, 1], [1, 2], [1, 3]])
        assert torch.allclose(points, expected)

    def test_padding(self):
        path = torch.rand(6, 10, 2)
        num = torch.tensor([10, 7, 4, 2, 1, 3])
        mask = torch.arange(10) < num[:, None]
        padded = path.masked_fill(~mask.unsqueeze(-1), torch.nan)
        points = resample_path(padded, mask, 21)
        for i, n in enumerate(num):
            alone = resample_path(path[i, :n], ones(n), 21)
            assert torch.allclose(points[i], alone, atol=1e-6)
            assert torch.allclose(points[i, 0], path[i, 0])
            assert torch.allclose(points[i, -1], path[i, n - 1])

    def test_distances_are_equal(self):
        angle = torch.rand(400, dtype=torch.double).sort().values * math.pi
        arc = torch.stack([angle.cos(), angle.sin()], -1)
        step = resample_path(arc, ones(400), 30).diff(dim=0).norm(dim=-1)
        assert step.max() / step.min() < 1.01

    def test_standing_still(self):
        path = torch.tensor([2.0, 1.0]).expand(5, 2)
        assert torch.equal(resample_path(path, ones(5), 3), path[:3])
        assert torch.equal(resample_path(path[:1], ones(1), 3), path[:3])

    def test_undefined(self):
        points = resample_path(torch.rand(2, 4, 2), torch.tensor([[True] * 4, [False] * 4]), 3)
        assert points.isnan().all((-1, -2)).tolist() == [False, True]

    def test_invalid(self):
        with pytest.raises(ValueError, match="num_points must be at least 2"):
            resample_path(torch.rand(4, 2), ones(4), 1)
