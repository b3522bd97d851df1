"""Tests of differences between means, and effect sizes.

Undefined values (NaN, such as the time of an episode that did not reach its goal) are dropped, from
pairs together with their partner, and what is left is counted. SciPy does the mathematics of
distributions. Arrays, tensors and lists all do; intervals of single means and rates are in
:mod:`torchrl_morl.evaluation.intervals`.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Literal, get_args

import numpy as np
import scipy.stats
from numpy.typing import ArrayLike

from .intervals import check_confidence, defined_values, finite

__all__ = ["TestResult", "cohen_d", "cohen_dz", "significance_mark", "t_test"]

Kind = Literal["paired", "student", "welch"]


@dataclasses.dataclass(frozen=True)
class TestResult:
    """Result of :func:`t_test`. Everything but ``n`` and ``difference`` is NaN without spread.

    Args:
        difference: of the means, first minus second.
        low: lower end of its confidence interval, corrected like ``p``.
        high: upper end.
        statistic: Student's t.
        dof: degrees of freedom.
        p: two-sided, multiplied by the number of comparisons (Bonferroni), at most 1.
        p_single: the same without the correction.
        effect: Cohen's d_z if paired (:func:`cohen_dz`), else Cohen's d (:func:`cohen_d`).
        n: values of the first and the second sample that counted.
    """

    __test__ = False  # pytest takes the name for a test

    difference: float
    low: float
    high: float
    statistic: float
    dof: float
    p: float
    p_single: float
    effect: float
    n: tuple[int, int]


def t_test(
    first: ArrayLike,
    second: ArrayLike,
    *,
    kind: Kind,
    comparisons: int = 1,
    confidence: float = 0.95,
) -> TestResult:
    r"""Test whether two means are equal, two-sided, with Bonferroni's correction.

    ``"paired"`` tests the mean of the differences, for the same scenes under two systems;
    ``"student"`` independent samples of one variance, as de Heuvel et al.
    (https://arxiv.org/abs/2404.04857) do; ``"welch"`` does without the equal variance. With ``m``
    comparisons p becomes :math:`\min(1, m p)`, and the interval that of confidence
    :math:`1 - \alpha / m`.

    Args:
        first: values of any shape; pairs must have the same one.
        second: values.

    Keyword Args:
        kind: of test.
        comparisons: how many tests the claim rests on.
        confidence: of the interval of the difference.

    Raises:
        ValueError: for pairs that do not match, an unknown kind, less than one comparison, or
            infinite values.

    Examples:
        >>> result = t_test([2.0, 4.0, 6.0], [1.0, 2.0, 3.0], kind="paired", comparisons=3)
        >>> result.difference, round(result.statistic, 3), round(result.p, 3), result.n
        (2.0, 3.464, 0.223, (3, 3))
    """
    if kind not in get_args(Kind):
        raise ValueError(f"kind must be 'paired', 'student' or 'welch', got {kind!r}.")
    if comparisons < 1:
        raise ValueError(f"comparisons must be at least 1, got {comparisons}.")
    check_confidence(confidence)
    if kind == "paired":
        first, second = _defined_pairs(first, second)
    else:
        first, second = defined_values(first), defined_values(second)
    n = (first.size, second.size)
    difference = float(first.mean() - second.mean()) if min(n) else math.nan
    effect = cohen_dz(first, second) if kind == "paired" else cohen_d(first, second)
    if math.isnan(effect):
        return TestResult(difference, *[math.nan] * 7, n=n)
    if kind == "paired":
        test = scipy.stats.ttest_rel(first, second)
    else:
        test = scipy.stats.ttest_ind(first, second, equal_var=kind == "student")
    interval = test.confidence_interval(1 - (1 - confidence) / comparisons)
    return TestResult(
        difference=difference,
        low=float(interval.low),
        high=float(interval.high),
        statistic=float(test.statistic),
        dof=float(test.df),
        p=min(1.0, comparisons * float(test.pvalue)),
        p_single=float(test.pvalue),
        effect=effect,
        n=n,
    )


def significance_mark(p: float) -> str:
    """``***`` below .001, ``**`` below .01, ``*`` below .05, else ``ns``; nothing for NaN.

    Examples:
        >>> significance_mark(0.003)
        '**'
    """
    if math.isnan(p):
        return ""
    return next((mark for mark, level in _MARKS.items() if p < level), "ns")


_MARKS = {"***": 0.001, "**": 0.01, "*": 0.05}


def cohen_d(first: ArrayLike, second: ArrayLike) -> float:
    r"""Cohen's d of independent samples, :math:`(\bar a - \bar b) / s`, without unit.

    :math:`s^2 = ((n_a - 1) s_a^2 + (n_b - 1) s_b^2) / (n_a + n_b - 2)` is the pooled variance
    (Cohen, Statistical Power Analysis for the Behavioral Sciences, 1988). NaN without spread.

    Examples:
        >>> round(cohen_d([1.0, 2.0, 3.0], [2.0, 4.0, 6.0]), 3)
        -1.265
    """
    first, second = defined_values(first), defined_values(second)
    freedom = first.size + second.size - 2
    if min(first.size, second.size) < 1 or freedom < 1:
        return math.nan
    squares = sum(float(((x - x.mean()) ** 2).sum()) for x in (first, second))
    return _ratio(float(first.mean() - second.mean()), math.sqrt(squares / freedom))


def cohen_dz(first: ArrayLike, second: ArrayLike) -> float:
    r"""Cohen's d of pairs, :math:`d_z = \bar \delta / s_\delta` of their differences, without unit.

    Not comparable with :func:`cohen_d`: it is divided by the spread of the differences, which is
    small where pairs go together (Lakens, https://doi.org/10.3389/fpsyg.2013.00863). NaN without
    spread or with less than two pairs.

    Raises:
        ValueError: if the numbers of values differ.

    Examples:
        >>> cohen_dz([2.0, 4.0, 6.0], [1.0, 2.0, 3.0])
        2.0
    """
    first, second = _defined_pairs(first, second)
    if first.size < 2:
        return math.nan
    difference = first - second
    return _ratio(float(difference.mean()), float(difference.std(ddof=1)))


def _ratio(difference: float, spread: float) -> float:
    # Rounding leaves a trace of spread where there is none.
    return difference / spread if spread > 1e-12 * max(1.0, abs(difference)) else math.nan


def _defined_pairs(first: ArrayLike, second: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    first, second = finite(first).ravel(), finite(second).ravel()
    if first.size != second.size:
        raise ValueError(f"pairs need as many values: {first.size} and {second.size}.")
    both = ~(np.isnan(first) | np.isnan(second))
    return first[both], second[both]
