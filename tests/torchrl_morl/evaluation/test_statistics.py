"""Tests and effect sizes against closed forms and against SciPy's own routines."""

from __future__ import annotations

import math

import pytest
import scipy.stats
import torch

from torchrl_morl.evaluation import cohen_d, cohen_dz, significance_mark, t_test

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
