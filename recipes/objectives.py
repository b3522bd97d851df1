"""The objectives that a user may weigh: one table for figures, tables, films and tests.

The reward itself is in :mod:`envs`: a training takes the entries that ``env.objectives`` names, and
"demo" behind the first of them where there is a reward model of demonstrations. A new objective is a
function of the reward there and a row here: ``docs/how_to/objective.md``.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from typing import Literal

import numpy as np
from matplotlib.colors import LinearSegmentedColormap, to_rgb
from numpy.typing import ArrayLike, NDArray

Values = Callable[[str], NDArray[np.float64]]
"""Every metric of ``docs/metrics.md`` by its name, one value an episode."""

DEMO = "demo"
"""The objective that is learned from demonstrations."""

EFFICIENCY = "efficiency"
"""The objective that every step costs the same."""

PERSONAL_SPACE = 2.0
"""Distance from which on the human does not care, metres: d_thresh of the paper."""

WORST_FRECHET = 3.0
"""Frechet distance that counts as no likeness at all, metres."""

WIDE_CLEARANCE = 1.0
"""Clearance to boxes from which on more is no better, metres: clearance_threshold of the reward."""


@dataclasses.dataclass(frozen=True)
class Objective:
    """An entry of the preference and what it does.

    Args:
        name: in the reward and in preferences.
        label: in pictures.
        color: in every picture and film, as a hex code. Mixtures of those of a policy must be told
            apart without red-green vision.
        metric: that it steers, a column of an evaluation.
        metric_label: with unit.
        sign: of the rank correlation between its weight and that metric.
        column: of the evaluations while training, the same metric.
        goodness: how well an episode serves it: 1 at best, 0 and less at worst, from its metrics.
    """

    name: str
    label: str
    color: str
    metric: str
    metric_label: str
    sign: Literal[-1, 1]
    column: str
    goodness: Callable[[Values], NDArray[np.float64]]


def _distance_goodness(values: Values) -> NDArray[np.float64]:
    surface = values("min_surface_distance")
    contact = values("min_human_distance") - surface
    return surface / (PERSONAL_SPACE - contact)


OBJECTIVES: dict[str, Objective] = {
    objective.name: objective
    for objective in (
        Objective(
            name=DEMO,
            label="demonstration",
            color="#d6336c",
            metric="frechet",
            metric_label="Frechet distance to the demonstration / m",
            sign=-1,
            column="frechet",
            goodness=lambda values: 1 - values("frechet") / WORST_FRECHET,
        ),
        Objective(
            name="distance",
            label="distance",
            color="#0b3c8c",
            metric="min_human_distance",
            metric_label="smallest distance to the human / m",
            sign=1,
            column="human",
            goodness=_distance_goodness,
        ),
        Objective(
            name=EFFICIENCY,
            label="efficiency",
            color="#f2b705",
            metric="time",
            metric_label="time to the goal / s",
            sign=-1,
            column="time",
            goodness=lambda values: np.nan_to_num(values("straight_time") / values("time")),
        ),
        Objective(
            name="clearance",
            label="clearance",
            color="#45b3a0",
            metric="min_clearance",
            metric_label="smallest clearance to a box / m",
            sign=1,
            column="clearance",
            goodness=lambda values: values("min_clearance") / WIDE_CLEARANCE,
        ),
    )
}
"""By name, in the order of pictures and tables."""


def reward_objectives(names: Iterable[str], *, with_demonstrations: bool) -> tuple[str, ...]:
    """Names of the entries of a training's reward.

    Args:
        names: of the environment's objectives, the one with a static weight first.

    Keyword Args:
        with_demonstrations: whether a reward model adds "demo", behind the first.

    Raises:
        ValueError: for an objective without a row in :data:`OBJECTIVES`.

    Examples:
        >>> reward_objectives(("core", "distance"), with_demonstrations=True)
        ('core', 'demo', 'distance')
    """
    static, *tunable = names
    tunable = [DEMO, *tunable] if with_demonstrations else tunable
    known(tunable)
    return (static, *tunable)


def known(names: Iterable[str]) -> list[Objective]:
    """Their rows.

    Raises:
        ValueError: for a name without one.
    """
    names = list(names)
    if missing := [name for name in names if name not in OBJECTIVES]:
        raise ValueError(
            f"objective {missing[0]!r} has no row in recipes/objectives.py, known are "
            f"{', '.join(OBJECTIVES)}: add one with its label, colour and metric."
        )
    return [OBJECTIVES[name] for name in names]


def preference_colors(preferences: ArrayLike, names: Sequence[str]) -> NDArray[np.float64]:
    """Colours ``[P, 3]`` of preferences ``[P, T]``: mixtures of those of the objectives.

    Raises:
        ValueError: for an objective without a row.

    Examples:
        >>> preference_colors([[1.0, 0.0]], ["efficiency", "distance"]).round(2).tolist()
        [[0.95, 0.72, 0.02]]
    """
    corners = np.array([to_rgb(objective.color) for objective in known(names)])
    return np.asarray(preferences, dtype=float) @ corners


def edge_map(first: str, second: str) -> LinearSegmentedColormap:
    """Colours between two objectives, the same as of :func:`preference_colors`."""
    low, high = known((first, second))
    return LinearSegmentedColormap.from_list(f"{first}_{second}", [low.color, high.color])
