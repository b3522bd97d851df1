"""Statistics of evaluations: intervals, t-tests and effect sizes of arrays.

Undefined values (NaN, such as the time of an episode that did not reach its goal) are dropped, from
pairs together with their partner, and what is left is counted: every result carries its ``n``. SciPy
does the mathematics of distributions. Arrays, tensors and lists all do.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Literal, get_args

import numpy as np
import scipy.stats
from numpy.typing import ArrayLike

__all__ = [
    "Interval",
    "TestResult",
    "bootstrap_interval",
    "cluster_rate_interval",
    "cohen_d",
    "cohen_dz",
    "interquartile_mean",
    "significance_mark",
    "t_test",
    "wilson_interval",
]

Kind = Literal["paired", "student", "welch"]
Statistic = Literal["mean", "iqm"]
Seeds = Literal["fixed", "resampled"]


@dataclasses.dataclass(frozen=True)
class Interval:
    """An estimate with its confidence interval.

    Args:
        estimate: NaN without values.
        low: lower end; NaN where the values do not say.
        high: upper end.
        n: number of values behind it.
    """

    estimate: float
    low: float
    high: float
    n: int


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
    _check_confidence(confidence)
    if kind == "paired":
        first, second = _defined_pairs(first, second)
    else:
        first, second = _defined(first), _defined(second)
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
    first, second = _defined(first), _defined(second)
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


def interquartile_mean(values: ArrayLike) -> float:
    """Mean of the middle half of all values, such as seeds x episodes; NaN without values.

    As robust as a median against outliers and steadier (Agarwal et al.,
    https://arxiv.org/abs/2108.13264). Where a quarter of the values is no whole number, the
    values at its edge count in part.

    Args:
        values: any shape.

    Examples:
        >>> interquartile_mean([100.0, 3.0, 1.0, -50.0])
        2.0
    """
    values = np.sort(_defined(values))
    if not values.size:
        return math.nan
    rank = np.arange(values.size)
    # How much of the unit interval of each rank lies in the middle half.
    weight = np.minimum(rank + 1, 0.75 * values.size) - np.maximum(rank, 0.25 * values.size)
    return float(np.average(values, weights=weight.clip(0)))


def bootstrap_interval(
    values: ArrayLike,
    *,
    statistic: Statistic = "mean",
    seeds: Seeds = "resampled",
    shared_episodes: bool = False,
    confidence: float = 0.95,
    resamples: int = 2000,
    seed: int = 0,
) -> Interval:
    """Percentile bootstrap interval of a mean over episodes, or over training seeds x episodes.

    With ``seeds="fixed"`` the seeds are strata: each keeps its share, and the interval is about
    these very policies (the stratified bootstrap of Agarwal et al.,
    https://arxiv.org/abs/2108.13264). With ``seeds="resampled"`` seeds are drawn first and then
    episodes within them, and the interval is about the training; of a handful of seeds it is
    rather too narrow.

    Args:
        values: ``[N]`` episodes or ``[S, N]``, one row a seed. NaN is dropped after drawing.

    Keyword Args:
        statistic: ``"mean"``, or ``"iqm"`` for :func:`interquartile_mean`; of all values together.
        seeds: what happens to the rows.
        shared_episodes: column ``i`` is the same scene in all rows, so that scenes are drawn
            once for all of them.
        confidence: of the interval.
        resamples: more are slower and steadier.
        seed: of the own random generator.

    Returns:
        Its ends are NaN with less than two values.

    Raises:
        ValueError: for other shapes, options that do not exist, or infinite values.

    Examples:
        >>> interval = bootstrap_interval([[1.0, 2.0, 3.0, 4.0], [2.0, 3.0, 4.0, float("nan")]])
        >>> round(interval.estimate, 3), interval.n, interval.low < interval.estimate
        (2.714, 7, True)
    """
    _check_confidence(confidence)
    for name, value, options in (("statistic", statistic, Statistic), ("seeds", seeds, Seeds)):
        if value not in get_args(options):
            raise ValueError(f"{name} must be one of {get_args(options)}, got {value!r}.")
    if resamples < 1:
        raise ValueError(f"resamples must be at least 1, got {resamples}.")
    table = _finite(values)
    if table.ndim not in (1, 2):
        raise ValueError(f"values must be [N] or [S, N], got {table.shape}.")
    table = np.atleast_2d(table)
    evaluate = np.mean if statistic == "mean" else interquartile_mean
    n = int((~np.isnan(table)).sum())
    if n == 0:
        return Interval(math.nan, math.nan, math.nan, 0)
    estimate = float(evaluate(table[~np.isnan(table)]))
    if n == 1:
        return Interval(estimate, math.nan, math.nan, 1)
    rng = np.random.default_rng(seed)
    num_seeds, num_episodes = table.shape
    statistics = np.empty(resamples)
    for index in range(resamples):  # one at a time: all together they fill the memory
        rows = rng.integers(num_seeds, size=num_seeds) if seeds == "resampled" else range(num_seeds)
        shape = (1 if shared_episodes else num_seeds, num_episodes)
        drawn = table[np.asarray(rows)[:, None], rng.integers(num_episodes, size=shape)]
        drawn = drawn[~np.isnan(drawn)]
        statistics[index] = evaluate(drawn) if drawn.size else math.nan
    tail = (1 - confidence) / 2
    low, high = np.nanquantile(statistics, [tail, 1 - tail])
    return Interval(estimate, float(low), float(high), n)


def wilson_interval(successes: float, n: float, *, confidence: float = 0.95) -> Interval:
    """Wilson's score interval of a rate: sensible also at rates of 0 and 1.

    Args:
        successes: from 0 to ``n``; like ``n`` no whole number if it is an effective one.
        n: independent trials.

    Keyword Args:
        confidence: of the interval.

    Raises:
        ValueError: for less than no and more than ``n`` successes.

    Examples:
        >>> interval = wilson_interval(100, 100)
        >>> interval.estimate, round(interval.low, 4), interval.high
        (1.0, 0.963, 1.0)
    """
    _check_confidence(confidence)
    if not 0 <= successes <= n:
        raise ValueError(f"successes must be from 0 to {n}, got {successes}.")
    if n == 0:
        return Interval(math.nan, math.nan, math.nan, 0)
    z, rate = float(scipy.stats.norm.ppf((1 + confidence) / 2)), successes / n
    middle = (rate + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * math.sqrt(rate * (1 - rate) / n + z * z / (4 * n * n))
    low = 0.0 if successes == 0 else middle - half
    high = 1.0 if successes == n else middle + half
    return Interval(rate, low, high, int(n))


def cluster_rate_interval(outcomes: ArrayLike, *, confidence: float = 0.95) -> Interval:
    """Interval of a rate over episodes that share scenes, and so are not independent.

    Wilson's interval with the effective number of episodes: ``n`` divided by the design effect, the
    variance of the rate over clusters by that of as many independent episodes (Korn and
    Graubard, Survey Methodology 24, 1998, there with another interval). At most ``n``, which it
    also is at rates of 0 and 1, where nothing tells clusters from episodes.

    Args:
        outcomes: 0, 1 or NaN, ``[clusters, episodes]``: one row a scene, with all its
            preferences and training seeds in it.

    Keyword Args:
        confidence: of the interval.

    Returns:
        ``n`` is the number of episodes.

    Raises:
        ValueError: for other shapes and values.

    Examples:
        Twenty scenes, each solved under all of 33 preferences or under none: 20 trials, not 660.

        >>> interval = cluster_rate_interval([[1] * 33] * 15 + [[0] * 33] * 5)
        >>> interval.n, round(interval.low, 2), round(wilson_interval(495, 660).low, 2)
        (660, 0.53, 0.72)
    """
    table = _finite(outcomes)
    if table.ndim != 2:
        raise ValueError(f"outcomes must be [clusters, episodes], got {table.shape}.")
    defined = ~np.isnan(table)
    if not np.isin(table[defined], (0, 1)).all():
        raise ValueError("outcomes must be 0 and 1, or NaN.")
    n = int(defined.sum())
    if not n:
        return Interval(math.nan, math.nan, math.nan, 0)
    rate = float(table[defined].mean())
    # Of the ratio of two sums over clusters, as clusters may differ in size.
    residuals = np.where(defined, table - rate, 0.0).sum(1)
    clusters = int(defined.any(1).sum())
    effective = float(n)
    if 0 < rate < 1 and clusters > 1:
        variance = clusters / (clusters - 1) * float((residuals**2).sum()) / n**2
        if variance > 0:
            effective = min(n, rate * (1 - rate) / variance)
    interval = wilson_interval(rate * effective, effective, confidence=confidence)
    return dataclasses.replace(interval, estimate=rate, n=n)


def _ratio(difference: float, spread: float) -> float:
    # Rounding leaves a trace of spread where there is none.
    return difference / spread if spread > 1e-12 * max(1.0, abs(difference)) else math.nan


def _finite(values: ArrayLike) -> np.ndarray:
    array = np.asarray(values, dtype=np.float64)
    if np.isinf(array).any():
        raise ValueError("A value is infinite: give a median or a share below a threshold instead.")
    return array


def _defined(values: ArrayLike) -> np.ndarray:
    array = _finite(values).ravel()
    return array[~np.isnan(array)]


def _defined_pairs(first: ArrayLike, second: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    first, second = _finite(first).ravel(), _finite(second).ravel()
    if first.size != second.size:
        raise ValueError(f"pairs need as many values: {first.size} and {second.size}.")
    both = ~(np.isnan(first) | np.isnan(second))
    return first[both], second[both]


def _check_confidence(confidence: float) -> None:
    if not 0 < confidence < 1:
        raise ValueError(f"confidence must be in (0, 1), got {confidence}.")
