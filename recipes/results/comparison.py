"""The numbers of Table I: from the episodes of a system to values with intervals and tests."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray

from torchrl_morl.evaluation import (
    Interval,
    TestResult,
    bootstrap_interval,
    cluster_rate_interval,
    expected_utility,
    hypervolume,
    interquartile_mean,
    steerability,
    t_test,
)

from ..objectives import known
from .files import Evaluation


@dataclasses.dataclass(frozen=True)
class Quantity:
    """A column of the table.

    Args:
        title: with unit.
        episodes: values ``[S, M, N]`` of an evaluation that count: training seeds, preferences,
            scenes; NaN where they do not. ``None`` where a system has none.
        digits: shown after the point.
        rate: the values are 0 and 1.
        higher: whether larger is better.
    """

    title: str
    episodes: Callable[[Evaluation], NDArray[np.float64] | None]
    digits: int
    rate: bool = False
    higher: bool = False

    def interval(self, evaluation: Evaluation) -> Interval | None:
        """Over scenes and, of several, training seeds; of rates in per cent, over scenes."""
        values = self.episodes(evaluation)
        if values is None:
            return None
        if self.rate:
            result = cluster_rate_interval(np.moveaxis(values, 2, 0).reshape(values.shape[2], -1))
            ends = (100 * end for end in (result.estimate, result.low, result.high))
            return Interval(*ends, n=result.n)
        return bootstrap_interval(values[:, 0], shared_episodes=True)

    def per_seed(self, evaluation: Evaluation) -> list[float]:
        """Mean of each training seed, of rates in per cent."""
        values = self.episodes(evaluation)
        return [] if values is None else [_mean(one) * (100 if self.rate else 1) for one in values]

    def robust(self, evaluation: Evaluation) -> float:
        """Interquartile mean over training seeds and scenes."""
        values = self.episodes(evaluation)
        return math.nan if values is None else interquartile_mean(values)

    def test(
        self, evaluation: Evaluation, other: Evaluation, comparisons: int
    ) -> TestResult | None:
        """Paired over scenes, each with its mean over training seeds and preferences."""
        pairs = self.episodes(evaluation), self.episodes(other)
        if any(values is None for values in pairs):
            return None
        first, second = (_scene_means(values) * (100 if self.rate else 1) for values in pairs)
        return t_test(first, second, kind="paired", comparisons=comparisons)


def _rate(*names: str) -> Callable[[Evaluation], NDArray[np.float64]]:
    return lambda evaluation: sum(evaluation.values(name) for name in names)


def _at(objective: str, name: str, *, free: bool = False) -> Callable[[Evaluation], NDArray | None]:
    def episodes(evaluation: Evaluation) -> NDArray[np.float64] | None:
        row = evaluation.corner(objective)
        if row is None:
            return None
        values = evaluation.values(name)[:, [row]]
        if free:
            values = np.where(
                evaluation.values("demonstration_free")[:, [row]] == 1, values, np.nan
            )
        return values

    return episodes


QUANTITIES: dict[str, Quantity] = {
    "success": Quantity("SR / %", _rate("success"), 2, rate=True, higher=True),
    "collision": Quantity("CR / %", _rate("collision_human", "collision_obstacle"), 2, rate=True),
    "timeout": Quantity("TR / %", _rate("timeout"), 2, rate=True),
    "min_human_distance": Quantity(
        "min d_h at dist / m", _at("distance", "min_human_distance"), 2, higher=True
    ),
    "frechet": Quantity("Frechet at demo, all / m", _at("demo", "frechet"), 2),
    "frechet_free": Quantity("Frechet at demo, free way / m", _at("demo", "frechet", free=True), 2),
    "time": Quantity("time at eff / s", _at("efficiency", "time"), 2),
}
"""Columns of the table, by name; those of :data:`recipes.results.paper.COLUMNS` among them."""


def ratio_to_bound(evaluation: Evaluation, bound: str) -> float:
    """Mean time at efficiency = 1 over the mean of a bound in the same, successful, episodes.

    Args:
        bound: ``"straight_time"`` or ``"shortest_time"``.
    """
    row = evaluation.corner("efficiency")
    if row is None:
        return math.nan
    time, least = (evaluation.values(name)[:, row] for name in ("time", bound))
    return _mean(time) / _mean(np.where(np.isnan(time), np.nan, least))


def steering(evaluation: Evaluation) -> dict[str, float]:
    """Rank correlation of each objective's weight with the metric that it steers.

    Over the preferences in which the objective is traded off, that is all but those of the edge
    where its weight is always zero.
    """
    if evaluation.summary["ignores_preference"]:
        return {}
    return {
        objective.name: _rank_correlation(evaluation, objective.name, objective.metric)
        for objective in known(evaluation.objectives)
    }


def exposure_steering(evaluation: Evaluation) -> float:
    """Rank correlation of the weight on distance with what that objective charges for, ideally -1.

    The smallest distance, which :func:`steering` takes, is another thing: between the demonstrated orbit
    and a wider way lie those who cut its corners. They come nearer, for a shorter time. NaN for
    who has no such weight, and for evaluations of before there was the column ``human_exposure``.
    """
    steers = not evaluation.summary["ignores_preference"] and "distance" in evaluation.objectives
    if not steers or "human_exposure" not in evaluation.columns:
        return math.nan
    return _rank_correlation(evaluation, "distance", "human_exposure")


def _rank_correlation(evaluation: Evaluation, objective: str, metric: str) -> float:
    """Of a weight and the mean of a metric, mean of the edges on which the weight varies."""
    size, entry = evaluation.edge_steps, list(evaluation.objectives).index(objective)
    values = np.moveaxis(evaluation.values(metric), 1, 0)
    means = np.array([_mean(one) for one in values])
    rho = []
    for start in range(0, len(means), size):
        weight = evaluation.preferences[start : start + size, entry]
        if np.ptp(weight) > 0:
            rho.append(steerability(torch.tensor(weight), torch.tensor(means[start:][:size])))
    return float(np.mean(rho))


def goodness(evaluation: Evaluation) -> NDArray[np.float64]:
    """How well each preference's behaviour serves each objective, ``[P, K]`` in [0, 1].

    Mean over episodes of what :data:`recipes.objectives.OBJECTIVES` says: Frechet distance, 1 at 0 m
    and 0 from 3 m; smallest distance to the human, 0 at contact and 1 from 2 m; straight-line time over
    the time needed, 0 without success.
    """
    served = [one.goodness(evaluation.values) for one in known(evaluation.objectives)]
    return np.stack([values.clip(0, 1).mean((0, 2)) for values in served], axis=-1)


def indicators(evaluation: Evaluation) -> dict[str, float]:
    """Hypervolume above 0 and expected utility of :func:`goodness`, of the sweep."""
    if evaluation.summary["ignores_preference"]:
        return {}
    values = torch.from_numpy(goodness(evaluation))
    weights = torch.from_numpy(evaluation.preferences)
    return {
        "hypervolume": hypervolume(values, torch.zeros(values.shape[1])),
        "expected utility": expected_utility(weights, values, choice="commanded"),
        "expected utility, best": expected_utility(weights, values),
    }


def _mean(values: NDArray[np.float64]) -> float:
    defined = values[~np.isnan(values)]
    return float(defined.mean()) if defined.size else math.nan


def _scene_means(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """``[S, M, N]`` to ``[N]``, NaN where nothing is defined."""
    defined = ~np.isnan(values)
    count = defined.sum((0, 1))
    total = np.where(defined, values, 0.0).sum((0, 1))
    return np.divide(total, count, out=np.full(count.shape, np.nan), where=count > 0)
