"""Intervals of means and rates against closed forms and against SciPy's own routines."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.stats
import torch

from torchrl_morl.evaluation import (
    bootstrap_interval,
    cluster_rate_interval,
    interquartile_mean,
    wilson_interval,
)

NAN = math.nan


# --- interquartile mean


def test_interquartile_mean_by_hand():
    assert interquartile_mean([100.0, 3.0, 1.0, -50.0]) == 2.0
    # A quarter of six values, rounded down, is one at each end.
    assert interquartile_mean([1, 20, 3, 4, 5, -6]) == (1 + 3 + 4 + 5) / 4
    assert interquartile_mean([7.0]) == 7.0
    assert math.isnan(interquartile_mean([NAN]))


def test_interquartile_mean_of_a_table_with_gaps():
    values = np.random.default_rng(0).normal(size=(4, 10))
    values[0, :4] = NAN  # of the 36 others, 9 are cut off at each end
    middle = np.sort(values[~np.isnan(values)])[9:27].mean()
    assert interquartile_mean(values) == pytest.approx(middle)
    assert interquartile_mean(torch.tensor(values)) == pytest.approx(middle)


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


def test_rate_of_one_counts_scenes():
    """Nothing tells scenes from episodes where all agree: ten scenes are ten trials, not thirty."""
    ten = wilson_interval(10, 10)
    perfect, some = cluster_rate_interval(np.ones((10, 3))), np.ones((10, 3))
    assert (perfect.estimate, perfect.low, perfect.high, perfect.n) == (1, ten.low, ten.high, 30)
    none = cluster_rate_interval(np.zeros((10, 3)))
    assert none.high == pytest.approx(1 - ten.low)
    some[0, 1:] = NAN
    undefined = cluster_rate_interval(some)
    assert (undefined.low, undefined.n) == (ten.low, 28)
    some[1] = NAN
    assert cluster_rate_interval(some).low == wilson_interval(9, 9).low


def test_rates_of_what_is_no_outcome_are_refused():
    with pytest.raises(ValueError, match="0 and 1"):
        cluster_rate_interval(np.full((2, 2), 0.5))
    with pytest.raises(ValueError, match=r"\[clusters, episodes\]"):
        cluster_rate_interval(np.ones(4))
