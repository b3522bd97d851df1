from __future__ import annotations

import math
import pickle

import pytest
import torch

from torchrl_morl.preferences import PreferenceSpace
from torchrl_morl.segments import PreferenceSegments

PAPER = PreferenceSpace(("core", "demo", "distance", "efficiency"), static={"core": 1.0})
DISTRIBUTIONS = ("dirichlet", "abs_normal")


def tunable_space(size: int) -> PreferenceSpace:
    return PreferenceSpace(tuple("abcdefgh"[:size]))


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


class TestSpace:
    def test_properties(self):
        preference_space = PreferenceSpace(("a", "s", "b", "t"), static={"t": -2, "s": 0.5})
        assert preference_space.num_objectives == 4
        assert preference_space.tunable == ("a", "b")
        assert preference_space.num_tunable == 2
        assert preference_space.tunable_indices == (0, 2)
        assert preference_space.static == (("s", 0.5), ("t", -2.0))

    def test_is_a_value(self):
        other = PreferenceSpace(["core", "demo", "distance", "efficiency"], {"core": 1})
        assert other == PAPER and hash(other) == hash(PAPER)
        assert PreferenceSpace(PAPER.objectives, static={"core": 2.0}) != PAPER
        assert pickle.loads(pickle.dumps(PAPER)) == PAPER
        with pytest.raises(AttributeError):
            PAPER.objectives = ("a",)

    @pytest.mark.parametrize(
        ("objectives", "static", "message"),
        [
            ((), {}, "at least one name"),
            (("a", ""), {}, r"objectives\[1\] must be a non-empty string, got ''"),
            (("a", 3), {}, r"objectives\[1\] must be a non-empty string, got 3"),
            (("a", "b", "a"), {}, r"objectives\[2\] repeats 'a'"),
            (("a", "b"), {"c": 1.0}, r"'c' is not an objective; allowed: \('a', 'b'\)"),
            (("a", "b"), {"a": math.nan}, "'a' must be finite, got nan"),
            (("a", "b"), {"a": math.inf}, "'a' must be finite, got inf"),
            (("a",), {"a": 1.0}, "at least one must be tunable"),
        ],
    )
    def test_invalid(self, objectives, static, message):
        with pytest.raises(ValueError, match=message):
            PreferenceSpace(objectives, static)

    def test_one_string_is_not_a_sequence_of_names(self):
        with pytest.raises(TypeError, match="'core'"):
            PreferenceSpace("core")


class TestValidate:
    def test_values_are_kept(self):
        value = torch.tensor([[0.2, 0.3, 0.5], [1.0, 0.0, 0.0]], dtype=torch.double)
        assert PAPER.validate(value) is value
        assert PAPER.validate([1, 0, 0]).dtype == torch.get_default_dtype()

    @pytest.mark.parametrize(
        ("value", "message"),
        [
            ([0.5, 0.5], r"shape \[\.\.\., 3\].*got \[2\]"),
            (1.0, r"got \[\]"),
            ([1.5, -0.5, 0.0], r"preference\[1\] = -0.5 for objective 'distance'"),
            (
                [[1.0, 0, 0], [0, 0, math.nan]],
                r"preference\[1, 2\] = nan for objective 'efficiency'",
            ),
            ([math.inf, 0.0, 0.0], r"preference\[0\] = inf for objective 'demo'"),
            ([0.5, 0.5, 0.5], r"preference = \[0.5, 0.5, 0.5\].*sums to 1.5; it must sum to 1"),
            ([[1.0, 0, 0], [0.25, 0, 0]], r"preference\[1\] = .*sums to 0.25"),
        ],
    )
    def test_message(self, value, message):
        with pytest.raises(ValueError, match=message):
            PAPER.validate(value)

    def test_tolerance(self):
        value = [0.5, 0.3, 0.201]
        assert PAPER.validate(value, tol=2e-3) is not None
        with pytest.raises(ValueError, match=r"within 0\.0001"):
            PAPER.validate(value)


class TestWeights:
    def test_static_weights_take_their_places(self):
        preference_space = PreferenceSpace(("a", "s", "b"), static={"s": -3.0})
        weights = preference_space.weights(torch.tensor([[[0.25, 0.75]], [[1.0, 0.0]]]))
        assert weights.tolist() == [[[0.25, -3.0, 0.75]], [[1.0, -3.0, 0.0]]]

    def test_differentiable(self):
        preference = PAPER.sample(5).requires_grad_()
        PAPER.weights(preference)[:, 2].sum().backward()
        assert preference.grad.tolist() == [[0.0, 1.0, 0.0]] * 5

    def test_compile(self):
        preference = PAPER.sample((2, 3))
        compiled = torch.compile(PAPER.weights, fullgraph=True, backend="eager")
        assert torch.equal(compiled(preference), PAPER.weights(preference))

    def test_wrong_size(self):
        with pytest.raises(ValueError, match=r"got \[4\]"):
            PAPER.weights(torch.ones(4))


class TestSample:
    @pytest.mark.parametrize("distribution", DISTRIBUTIONS)
    @pytest.mark.parametrize("size", [1, 2, 5])
    @pytest.mark.parametrize("shape", [(), 7, (2, 3)])
    def test_on_the_simplex(self, distribution, size, shape):
        preference_space = tunable_space(size)
        value = preference_space.sample(shape, distribution, generator())
        expected = (shape,) if isinstance(shape, int) else shape
        assert value.shape == (*expected, size)
        preference_space.validate(value, tol=1e-6)

    @pytest.mark.parametrize("distribution", DISTRIBUTIONS)
    def test_exchangeable(self, distribution):
        assert PAPER.sample(50_000, distribution, generator()).mean(0).sub(1 / 3).abs().max() < 5e-3

    def test_dirichlet_is_uniform(self):
        # Under the uniform distribution on the triangle P(p_0 > x) = (1 - x)^2.
        first = PAPER.sample(50_000, "dirichlet", generator())[:, 0]
        for x in (0.1, 0.5, 0.9):
            assert (first > x).float().mean().item() == pytest.approx((1 - x) ** 2, abs=8e-3)

    def test_abs_normal_density(self):
        # The density is proportional to |p|_2^-T: weighed with |p|_2^T, the mean is that of the
        # uniform distribution.
        value = PAPER.sample(100_000, "abs_normal", generator())
        weight = value.norm(dim=-1).pow(3)
        corner = (value[:, 0] > 0.8).float()
        assert corner.mean() < 0.03  # 0.04 under the uniform distribution
        assert ((weight * corner).sum() / weight.sum()).item() == pytest.approx(0.04, abs=3e-3)

    def test_seed(self):
        for distribution in DISTRIBUTIONS:
            first, again = (PAPER.sample(9, distribution, generator(1)) for _ in range(2))
            assert torch.equal(first, again)
            assert not torch.equal(first, PAPER.sample(9, distribution, generator(2)))

    def test_unknown_distribution(self):
        with pytest.raises(ValueError, match=r"'dirichlet', 'abs_normal'.*'uniform'"):
            PAPER.sample(3, "uniform")


class TestGrids:
    def test_corners(self):
        assert torch.equal(PAPER.corners(), torch.eye(3))

    @pytest.mark.parametrize("size", [1, 2, 3, 5])
    @pytest.mark.parametrize("divisions", [1, 3, 10])
    def test_lattice(self, size, divisions):
        preference_space = tunable_space(size)
        lattice = preference_space.lattice(divisions)
        assert len(lattice) == math.comb(divisions + size - 1, size - 1)
        preference_space.validate(lattice, tol=1e-6)
        counts = lattice * divisions
        assert torch.allclose(counts, counts.round(), atol=1e-5)
        assert len(counts.round().unique(dim=0)) == len(lattice)

    def test_lattice_has_the_points_a_float_filter_loses(self):
        assert len(PAPER.lattice(20)) == 231

    def test_pairwise_grid_is_that_of_the_paper(self):
        mu = [i / 10 for i in range(11)]
        rows = [(0, m, 1 - m) for m in mu] + [(m, 1 - m, 0) for m in mu]
        rows += [(1 - m, 0, m) for m in mu]
        grid = PAPER.pairwise_grid()
        assert grid.shape == (33, 3)
        assert torch.allclose(grid, torch.tensor(rows), atol=1e-7)
        for corner in torch.eye(3):
            assert (grid == corner).all(-1).sum() == 2

    def test_pairwise_grid_of_two(self):
        grid = tunable_space(2).pairwise_grid()
        mu = torch.arange(11) / 10
        assert torch.allclose(grid, torch.stack([mu, 1 - mu], -1), atol=1e-7)

    @pytest.mark.parametrize("size", [1, 4, 5])
    def test_pairwise_grid_has_every_edge_once(self, size):
        preference_space = tunable_space(size)
        grid = preference_space.pairwise_grid(3)
        preference_space.validate(grid)
        middles = grid[((grid > 0).sum(-1) == 2)]
        assert len(middles.unique(dim=0)) == len(middles) == math.comb(size, 2)
        assert len(grid) == max(1, 3 * math.comb(size, 2))

    def test_invalid(self):
        with pytest.raises(ValueError, match=r"divisions.*got 0"):
            PAPER.lattice(0)
        with pytest.raises(ValueError, match=r"steps.*got 1"):
            PAPER.pairwise_grid(1)


class TestSegments:
    def test_slabs_rise_with_the_first_entry(self):
        """Thirds of the uniform law on the triangle: the first entry is below 1 - sqrt(1 - k / 3)."""
        segments = PreferenceSegments(PAPER, 3, slabs=True)
        edges = [1 - (1 - share) ** 0.5 for share in (0.0, 1 / 3, 2 / 3, 1.0)]
        for cell in range(3):
            drawn = segments.sample(torch.full((2000,), cell), "dirichlet", generator())
            assert drawn[:, 0].min() >= edges[cell] - 1e-6
            assert drawn[:, 0].max() <= edges[cell + 1] + 1e-6
            assert (segments.index(drawn) == cell).all()
            # The second takes any share of the rest.
            share = drawn[:, 1] / (1 - drawn[:, 0])
            assert share.mean().item() == pytest.approx(0.5, abs=0.03)
        at = torch.tensor([[0.0, 1.0, 0.0], [0.3, 0.0, 0.7], [1.0, 0.0, 0.0]])
        assert segments.index(at).tolist() == [0, 1, 2]

    def test_slabs_of_two_objectives_are_the_cells(self):
        value = tunable_space(2).sample(100, "dirichlet", generator())
        cells, slabs = (PreferenceSegments(tunable_space(2), 4, slabs) for slabs in (False, True))
        assert torch.equal(cells.index(value), slabs.index(value))

    @pytest.mark.parametrize("size", [2, 3, 4, 6])
    @pytest.mark.parametrize("count", [1, 2, 3, 4, 7, 10])
    def test_balance(self, size, count):
        preference_space = tunable_space(size)
        index = PreferenceSegments(preference_space, count).index(
            preference_space.sample(40_000, generator=generator())
        )
        share = index.bincount(minlength=count) / len(index)
        assert len(share) == count
        # Five standard deviations of a binomial share.
        assert (share - 1 / count).abs().max() <= 5 * math.sqrt(1 / count / len(index))

    @pytest.mark.parametrize("size", [2, 3, 5])
    @pytest.mark.parametrize("count", [1, 2, 4, 9])
    def test_every_preference_is_in_exactly_one_cell(self, size, count):
        segments = PreferenceSegments(tunable_space(size), count)
        lower, upper = segments._boxes(torch.device("cpu"))
        assert (upper - lower).prod(-1).sub(1 / count).abs().max() < 1e-12
        cube = torch.cartesian_prod(*[torch.linspace(0, 1, 9).double()] * (size - 1))
        cube = torch.cat([cube.reshape(-1, size - 1), lower, upper]).unsqueeze(-2)
        inside = (cube >= lower) & ((cube < upper) | (upper == 1))
        assert (inside.all(-1).sum(-1) == 1).all()

    @pytest.mark.parametrize("size", [2, 3, 5])
    @pytest.mark.parametrize("count", [2, 3, 5, 8])
    def test_boundary_has_a_cell(self, size, count):
        preference_space = tunable_space(size)
        border = torch.cat(
            [
                preference_space.corners(),
                preference_space.pairwise_grid(5),
                preference_space.lattice(4),
            ]
        )
        index = PreferenceSegments(preference_space, count).index(border)
        assert index.min() >= 0 and index.max() < count and index.unique().numel() > 1

    def test_natural_cells(self):
        segments = PreferenceSegments(PAPER, 3)
        assert segments == PreferenceSegments(PAPER, 3)
        value = PAPER.sample((50, 2), generator=generator())
        nearest = (value.unsqueeze(-2) - PAPER.corners()).norm(dim=-1).argmin(-1)
        assert torch.equal(segments.index(value), nearest)

    def test_more_than_one_coordinate_is_cut(self):
        value = PAPER.sample(2000, generator=generator())
        index = PreferenceSegments(PAPER, 4).index(value)
        narrow = (value[:, 0] - 0.2).abs() < 0.02
        assert index[narrow].unique().numel() > 1

    @pytest.mark.parametrize("distribution", DISTRIBUTIONS)
    @pytest.mark.parametrize(("size", "count"), [(2, 2), (2, 5), (3, 1), (3, 3), (3, 4), (4, 6)])
    def test_sample_follows_the_distribution_within_the_cell(self, distribution, size, count):
        preference_space = tunable_space(size)
        segments = PreferenceSegments(preference_space, count)
        wanted = torch.arange(3000 * count).reshape(-1, 2) % count
        value = segments.sample(wanted, distribution, generator())
        assert value.shape == (*wanted.shape, size)
        preference_space.validate(value, tol=1e-5)
        assert torch.equal(segments.index(value), wanted)
        free = preference_space.sample(20_000 * count, distribution, generator(1))
        index = segments.index(free)
        for cell in range(count):
            drawn, expected = value[wanted == cell], free[index == cell]
            assert (drawn.mean(0) - expected.mean(0)).abs().max() < 0.02
            assert (drawn.std(0) - expected.std(0)).abs().max() < 0.02

    @pytest.mark.parametrize("count", [1, 2, 5])
    def test_one_tunable_objective(self, count):
        segments = PreferenceSegments(tunable_space(1), count)
        assert segments.index(torch.ones(4, 1)).tolist() == [0] * 4
        for distribution in DISTRIBUTIONS:
            assert segments.sample(torch.arange(4) % count, distribution).tolist() == [[1.0]] * 4

    @pytest.mark.parametrize("count", [3, 4])
    def test_seed(self, count):
        segments = PreferenceSegments(PAPER, count)
        index = torch.arange(10) % count
        for distribution in DISTRIBUTIONS:
            first, again = (segments.sample(index, distribution, generator(1)) for _ in range(2))
            assert torch.equal(first, again)
            assert not torch.equal(first, segments.sample(index, distribution, generator(2)))

    def test_invalid(self):
        with pytest.raises(ValueError, match="got 0"):
            PreferenceSegments(PAPER, 0)
        with pytest.raises(ValueError, match="'uniform'"):
            PreferenceSegments(PAPER, 3).sample(torch.tensor([0]), "uniform")
        with pytest.raises(ValueError, match=r"got \[2\]"):
            PreferenceSegments(PAPER, 3).index(torch.ones(2))
