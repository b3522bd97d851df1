"""Intervals, tests and effect sizes against closed forms and against SciPy's own routines."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.stats
import torch

from torchrl_morl.evaluation import (
    bootstrap_interval,
    cluster_rate_interval,
    cohen_d,
    cohen_dz,
    interquartile_mean,
    significance_mark,
    t_test,
    wilson_interval,
)

NAN = math.nan
A = [5.1, 4.9, 6.2, 5.7, 5.5]
B = [4.1, 4.6, 5.0, 4.4, 4.9]


# --- t-tests


def test_paired_by_hand():
    """Differences 1, 2, 3: mean 2, deviation 1, t = 2 sqrt(3) with two degrees of freedom."""
    result = t_test([2.0, 4.0, 6.0], [1.0, 2.0, 3.0], kind="paired")
    assert result.difference == 2.0
    assert result.statistic == pytest.approx(2 * math.sqrt(3))
    assert (result.dof, result.n) == (2.0, (3, 3))
    # With two degrees of freedom Student's distribution has a closed form.
    t = result.statistic
    assert result.p == pytest.approx(1 - t / math.sqrt(2 + t * t))
    assert result.effect == 2.0


def test_welch_by_hand():
    """Variances 1 and 4 over three and four values."""
    first, second = [1.0, 2.0, 3.0], [4.0, 8.0, 6.0, 6.0]
    variances = (1.0, 8 / 3)
    error = variances[0] / 3 + variances[1] / 4
    result = t_test(first, second, kind="welch")
    assert result.difference == -4.0
    assert result.statistic == pytest.approx(-4.0 / math.sqrt(error))
    dof = error**2 / ((variances[0] / 3) ** 2 / 2 + (variances[1] / 4) ** 2 / 3)
    assert result.dof == pytest.approx(dof)
    assert result.n == (3, 4)


@pytest.mark.parametrize(
    ("kind", "other"),
    [
        ("paired", lambda a, b: scipy.stats.ttest_rel(a, b)),
        ("student", lambda a, b: scipy.stats.ttest_ind(a, b)),
        ("welch", lambda a, b: scipy.stats.ttest_ind(a, b, equal_var=False)),
    ],
)
def test_against_scipy(kind, other):
    result, expected = t_test(A, B, kind=kind), other(A, B)
    assert result.statistic == pytest.approx(expected.statistic)
    assert result.p == pytest.approx(expected.pvalue)
    assert result.dof == pytest.approx(expected.df)
    interval = expected.confidence_interval(0.95)
    assert (result.low, result.high) == pytest.approx((interval.low, interval.high))


def test_bonferroni_multiplies_and_widens():
    alone, among = t_test(A, B, kind="welch"), t_test(A, B, kind="welch", comparisons=5)
    assert among.p == pytest.approx(5 * alone.p)
    assert among.p_single == alone.p
    wider = scipy.stats.ttest_ind(A, B, equal_var=False).confidence_interval(1 - 0.05 / 5)
    assert (among.low, among.high) == pytest.approx((wider.low, wider.high))
    assert t_test(A, B[::-1], kind="welch", comparisons=10**6).p == 1.0


def test_undefined_values_leave_in_pairs_or_alone():
    paired = t_test([*A, NAN, 1.0], [*B, 2.0, NAN], kind="paired")
    assert paired == t_test(A, B, kind="paired")
    welch = t_test([*A, NAN], [NAN, *B, NAN], kind="welch")
    assert welch == t_test(A, B, kind="welch")


@pytest.mark.parametrize("kind", ["paired", "student", "welch"])
def test_without_spread_there_is_no_test(kind):
    """A difference without any spread leaves the statistic without a value, not infinite."""
    for first, second in (([1.0], [2.0]), ([], []), ([1.0, 1.0], [2.0, 2.0])):
        result = t_test(first, second, kind=kind)
        assert math.isnan(result.p) and math.isnan(result.statistic)
        assert result.n == (len(first), len(second))
    same = t_test([3.0, 3.0], [3.0, 3.0], kind=kind)
    assert same.difference == 0.0 and math.isnan(same.p)


def test_what_a_test_refuses():
    with pytest.raises(ValueError, match="pairs need as many values: 2 and 3"):
        t_test([1, 2], [1, 2, 3], kind="paired")
    with pytest.raises(ValueError, match="'paired', 'student' or 'welch', got 'mann'"):
        t_test(A, B, kind="mann")
    with pytest.raises(ValueError, match="comparisons must be at least 1, got 0"):
        t_test(A, B, kind="welch", comparisons=0)
    with pytest.raises(ValueError, match="infinite"):
        t_test([1.0, math.inf], [1.0, 2.0], kind="paired")


# --- effect sizes


def test_effect_sizes_by_hand():
    # Variances 1 and 4 with as many values each: pooled 2.5.
    assert cohen_d([1.0, 2.0, 3.0], [2.0, 4.0, 6.0]) == pytest.approx(-2 / math.sqrt(2.5))
    # Of unequal numbers: (2 * 1 + 1 * 2) / 3.
    assert cohen_d([1.0, 2.0, 3.0], [4.0, 6.0]) == pytest.approx(-3 / math.sqrt(4 / 3))
    assert cohen_dz([2.0, 4.0, 6.0], [1.0, 2.0, 3.0]) == 2.0
    assert cohen_dz(torch.tensor([2.0, 4.0, NAN]), torch.tensor([1.0, 1.0, 3.0])) == pytest.approx(
        2 / math.sqrt(2)
    )


def test_effect_size_without_spread():
    assert math.isnan(cohen_d([1.0, 1.0], [2.0, 2.0]))
    assert math.isnan(cohen_dz([1.0], [2.0]))


@pytest.mark.parametrize(
    ("p", "mark"),
    [
        (0.0009, "***"),
        (0.001, "**"),
        (0.009, "**"),
        (0.01, "*"),
        (0.05, "ns"),
        (1, "ns"),
        (NAN, ""),
    ],
)
def test_marks(p, mark):
    assert significance_mark(p) == mark


# --- interquartile mean


def test_interquartile_mean_by_hand():
    assert interquartile_mean([100.0, 3.0, 1.0, -50.0]) == 2.0
    # Of six values one and a half are cut off at each end: half of the 2 and half of the 5 count.
    assert interquartile_mean([1, 2, 3, 4, 5, 6]) == pytest.approx((0.5 * 2 + 3 + 4 + 0.5 * 5) / 3)
    assert interquartile_mean([7.0]) == 7.0
    assert math.isnan(interquartile_mean([NAN]))


def test_interquartile_mean_against_scipy():
    values = np.random.default_rng(0).normal(size=(4, 10))  # 40 values: whole quarters
    assert interquartile_mean(values) == pytest.approx(scipy.stats.trim_mean(values.ravel(), 0.25))
    values[0, :4] = NAN
    defined = values[~np.isnan(values)]
    assert interquartile_mean(torch.tensor(values)) == pytest.approx(
        scipy.stats.trim_mean(defined, 0.25)
    )


# --- bootstrap


def test_bootstrap_is_that_of_scipy():
    values = np.random.default_rng(1).exponential(size=60)
    mine = bootstrap_interval(values, resamples=20_000, seed=2)
    other = scipy.stats.bootstrap(
        (values,), np.mean, n_resamples=20_000, method="percentile", rng=np.random.default_rng(3)
    ).confidence_interval
    assert mine.estimate == pytest.approx(values.mean())
    assert mine.n == 60
    assert mine.low == pytest.approx(other.low, abs=0.01)
    assert mine.high == pytest.approx(other.high, abs=0.01)


def test_bootstrap_can_be_repeated_and_leaves_other_generators_alone():
    values = np.random.default_rng(1).normal(size=20)
    before = np.random.get_state()[1].copy(), torch.get_rng_state()
    assert bootstrap_interval(values, seed=3) == bootstrap_interval(values, seed=3)
    assert bootstrap_interval(values, seed=3) != bootstrap_interval(values, seed=4)
    assert (np.random.get_state()[1] == before[0]).all()
    assert torch.equal(torch.get_rng_state(), before[1])


def test_seeds_that_differ_widen_the_interval_only_if_resampled():
    rng = np.random.default_rng(0)
    values = np.array([[0.0], [1.0], [2.0]]) + 0.01 * rng.normal(size=(3, 50))
    fixed = bootstrap_interval(values, seeds="fixed")
    drawn = bootstrap_interval(values, seeds="resampled")
    assert fixed.high - fixed.low < 0.01
    # Three seeds drawn with replacement: all are the first, or all the last, once in 27 times.
    assert (drawn.low, drawn.high) == pytest.approx((0.0, 2.0), abs=0.02)
    assert fixed.n == drawn.n == 150
    assert fixed.estimate == drawn.estimate == pytest.approx(values.mean())


def test_scenes_that_all_seeds_share_are_drawn_together():
    """Three copies of the same episodes say no more than one of them."""
    episodes = np.random.default_rng(0).normal(size=40)
    copies = np.stack([episodes] * 3)
    once = bootstrap_interval(episodes, seed=1)
    together = bootstrap_interval(copies, seeds="fixed", shared_episodes=True, seed=1)
    apart = bootstrap_interval(copies, seeds="fixed", seed=1)
    assert together.high - together.low == pytest.approx(once.high - once.low, rel=0.1)
    assert apart.high - apart.low == pytest.approx((once.high - once.low) / math.sqrt(3), rel=0.1)


def test_undefined_values_are_dropped_by_the_bootstrap():
    values = np.array([[1.0, NAN, 3.0], [NAN, NAN, 2.0]])
    interval = bootstrap_interval(values)
    assert (interval.estimate, interval.n) == (2.0, 3)
    assert 1.0 <= interval.low <= interval.high <= 3.0
    nothing = bootstrap_interval([NAN, NAN])
    assert nothing.n == 0 and math.isnan(nothing.estimate) and math.isnan(nothing.low)
    single = bootstrap_interval([4.0])
    assert single.estimate == 4.0 and math.isnan(single.low)


def test_bootstrap_of_the_interquartile_mean():
    values = [0.0] * 11 + [1.0] * 12 + [1000.0] * 2
    interval = bootstrap_interval(values, statistic="iqm")
    assert interval.estimate == interquartile_mean(values)
    assert interval.high <= 1.0 < 20 < bootstrap_interval(values).high


def test_what_the_bootstrap_refuses():
    with pytest.raises(ValueError, match=r"\[N\] or \[S, N\], got \(1, 1, 1\)"):
        bootstrap_interval(np.zeros((1, 1, 1)))
    with pytest.raises(ValueError, match="confidence must be in"):
        bootstrap_interval([1.0, 2.0], confidence=95)
    with pytest.raises(ValueError, match="statistic must be"):
        bootstrap_interval([1.0, 2.0], statistic="median")
    with pytest.raises(ValueError, match="seeds must be"):
        bootstrap_interval([1.0, 2.0], seeds="drawn")
    with pytest.raises(ValueError, match="resamples must be at least 1"):
        bootstrap_interval([1.0, 2.0], resamples=0)


# --- rates


@pytest.mark.parametrize(("k", "n"), [(0, 20), (7, 20), (20, 20), (3289, 3300)])
def test_wilson_against_scipy(k, n):
    mine = wilson_interval(k, n)
    other = scipy.stats.binomtest(k, n).proportion_ci(method="wilson")
    assert (mine.low, mine.high) == pytest.approx((other.low, other.high))
    assert (mine.estimate, mine.n) == (k / n, n)


def test_wilson_without_trials_and_of_nonsense():
    assert math.isnan(wilson_interval(0, 0).estimate)
    with pytest.raises(ValueError, match="successes must be from 0 to 5, got 6"):
        wilson_interval(6, 5)


def test_rate_over_clusters_that_agree_within_has_as_many_trials_as_clusters():
    """Each scene solved under all preferences or under none: a scene is one trial."""
    clusters = np.repeat(np.array([[1.0]] * 15 + [[0.0]] * 5), 33, axis=1)
    interval = cluster_rate_interval(clusters)
    # n - 1 instead of n is the correction of the variance between clusters.
    expected = wilson_interval(0.75 * 19, 19)
    assert (interval.estimate, interval.n) == (0.75, 20 * 33)
    assert (interval.low, interval.high) == pytest.approx((expected.low, expected.high))


def test_rate_over_independent_episodes_has_as_many_trials_as_episodes():
    episodes = np.random.default_rng(0).random((2000, 10)) < 0.9
    interval = cluster_rate_interval(episodes)
    wilson = wilson_interval(int(episodes.sum()), episodes.size)
    assert interval.high - interval.low == pytest.approx(wilson.high - wilson.low, rel=0.1)


def test_rate_of_one_and_undefined_episodes():
    perfect = cluster_rate_interval(np.ones((10, 3)))
    assert perfect == wilson_interval(30, 30)
    some = np.ones((10, 3))
    some[0, 1:] = NAN
    assert cluster_rate_interval(some) == wilson_interval(28, 28)
    with pytest.raises(ValueError, match="0 and 1"):
        cluster_rate_interval(np.full((2, 2), 0.5))
    with pytest.raises(ValueError, match=r"\[clusters, episodes\]"):
        cluster_rate_interval(np.ones(4))
