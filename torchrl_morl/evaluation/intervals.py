"""Intervals of means and rates over episodes, with their number.

Undefined values (NaN, such as the time of an episode that did not reach its goal) are dropped, and
what is left is counted. Arrays, tensors and lists all do.
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
    "bootstrap_interval",
    "cluster_rate_interval",
    "interquartile_mean",
    "wilson_interval",
]

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


def interquartile_mean(values: ArrayLike) -> float:
    """Mean of the middle half of all values, such as seeds x episodes; NaN without values.

    As robust as a median against outliers and steadier (Agarwal et al.,
    https://arxiv.org/abs/2108.13264). As there, a quarter that is no whole number of values is
    rounded down.

    Args:
        values: any shape.

    Examples:
        >>> interquartile_mean([100.0, 3.0, 1.0, -50.0])
        2.0
    """
    values = defined_values(values)
    return float(scipy.stats.trim_mean(values, 0.25)) if values.size else math.nan


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
    check_confidence(confidence)
    for name, value, options in (("statistic", statistic, Statistic), ("seeds", seeds, Seeds)):
        if value not in get_args(options):
            raise ValueError(f"{name} must be one of {get_args(options)}, got {value!r}.")
    if resamples < 1:
        raise ValueError(f"resamples must be at least 1, got {resamples}.")
    table = finite(values)
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
    check_confidence(confidence)
    if not 0 <= successes <= n:
        raise ValueError(f"successes must be from 0 to {n}, got {successes}.")
    if n == 0:
        return Interval(math.nan, math.nan, math.nan, 0)
    # By hand, as scipy.stats.binomtest takes whole numbers only.
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
    Graubard, Survey Methodology 24, 1998, there with another interval). At most ``n``. At rates of 0 and
    1 no variance is left to tell by: then clusters count, once each, since the episodes of a scene may
    all have agreed because of the scene.

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

        A hundred scenes without a failure: a hundred trials, not 3,300.

        >>> interval = cluster_rate_interval([[1] * 33] * 100)
        >>> interval.n, round(interval.low, 3)
        (3300, 0.963)
    """
    table = finite(outcomes)
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
    effective = float(n) if 0 < rate < 1 else float(clusters)
    if 0 < rate < 1 and clusters > 1:
        variance = clusters / (clusters - 1) * float((residuals**2).sum()) / n**2
        if variance > 0:
            effective = min(n, rate * (1 - rate) / variance)
    interval = wilson_interval(rate * effective, effective, confidence=confidence)
    return dataclasses.replace(interval, estimate=rate, n=n)


def finite(values: ArrayLike) -> np.ndarray:
    """Float64 array; ValueError for infinite values."""
    array = np.asarray(values, dtype=np.float64)
    if np.isinf(array).any():
        raise ValueError("A value is infinite: give a median or a share below a threshold instead.")
    return array


def defined_values(values: ArrayLike) -> np.ndarray:
    """What is not NaN, in one dimension."""
    array = finite(values).ravel()
    return array[~np.isnan(array)]


def check_confidence(confidence: float) -> None:
    """ValueError unless it is in (0, 1)."""
    if not 0 < confidence < 1:
        raise ValueError(f"confidence must be in (0, 1), got {confidence}.")
