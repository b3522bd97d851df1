"""The quantitative figure: metrics over the 33 preferences, with intervals and tests."""

from __future__ import annotations

import itertools
import textwrap
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray

from torchrl_morl.evaluation import bootstrap_interval, significance_mark, t_test

from ..objectives import known, preference_colors
from .files import Evaluation

PANELS = {
    objective.metric: textwrap.fill(objective.metric_label, 24)
    for objective in known(("efficiency", "demo", "clearance", "distance"))
}
_CORE = {"color": "black", "linestyle": ":", "linewidth": 1.2}
STYLE = {"font.size": 7, "axes.linewidth": 0.6, "xtick.major.width": 0.6, "ytick.major.width": 0.6}


def corner_tests(evaluation: Evaluation, name: str) -> dict[tuple[int, int], float]:
    """p of the difference between neighbouring corners, by their places on the axis.

    Paired over scenes (each with its mean over training seeds), Bonferroni for all of them.
    """
    rows = _corner_rows(evaluation)
    pairs = [(a, b) for a, b in itertools.pairwise(rows) if b - a > 1]
    values = evaluation.values(name)
    means = {row: _mean_over_seeds(values[:, row]) for row in rows}
    return {
        (a, b): t_test(means[a], means[b], kind="paired", comparisons=len(pairs)).p
        for a, b in pairs
    }


def quantitative_figure(path: Path, evaluation: Evaluation, core: Evaluation | None = None) -> None:
    """Means with 95 % intervals over the preferences, one panel a metric, at column width.

    Args:
        path: file to write.
        evaluation: of a system that follows preferences.
        core: one that ignores them, a line in every panel, or a note where it lies far away.

    Raises:
        ValueError: if ``evaluation`` ignores preferences.
    """
    if evaluation.summary["ignores_preference"]:
        raise ValueError(f"{evaluation.system} ignores preferences: nothing to show over them.")
    preferences = evaluation.preferences
    place = np.arange(len(preferences))
    colors = preference_colors(preferences, evaluation.objectives)
    with plt.rc_context(STYLE):
        fig, axes = plt.subplots(
            len(PANELS) + 1,
            1,
            figsize=(3.5, 6.6),
            height_ratios=[1] * len(PANELS) + [0.55],
            sharex=True,
            layout="constrained",
        )
        for letter, ax, (name, label) in zip("abcd", axes, PANELS.items()):
            _panel(ax, evaluation, name, colors, core)
            ax.set_ylabel(label)
            ax.grid(axis="y", alpha=0.3, linewidth=0.5)
            ax.text(0.01, 0.97, f"({letter})", transform=ax.transAxes, va="top", weight="bold")
        _shares(axes[-1], preferences, evaluation.objectives, core)
        axes[-1].set_xlim(-0.8, len(place) - 0.2)
        fig.savefig(path, dpi=300)
    plt.close(fig)


def _panel(
    ax: plt.Axes, evaluation: Evaluation, name: str, colors: NDArray, core: Evaluation | None
) -> None:
    values = evaluation.values(name)
    tops = []
    for row in range(values.shape[1]):
        interval = bootstrap_interval(values[:, row], shared_episodes=True, resamples=1000)
        if not interval.n:
            continue
        ax.plot(
            [row, row], [interval.low, interval.high], color=colors[row], linewidth=2.2, alpha=0.55
        )
        ax.plot(
            row,
            interval.estimate,
            marker="o",
            markersize=4,
            color=colors[row],
            markeredgecolor="black",
            markeredgewidth=0.4,
        )
        tops.append(np.nanmax([interval.estimate, interval.high]))
    low, high = ax.get_ylim()
    middle = np.nan if core is None else _mean_where_any(_mean_over_seeds(core.values(name)[:, 0]))
    # A line far away would press everything else flat.
    far = not low - (high - low) < middle < high + (high - low)
    if not np.isnan(middle) and not far:
        ax.axhline(middle, **_CORE)
        tops.append(middle)
        low, high = ax.get_ylim()
    bar = max(tops, default=high) + 0.06 * (high - low)
    for (first, second), p in corner_tests(evaluation, name).items():
        inner = first + 0.3, second - 0.3
        drop = bar - 0.03 * (high - low)
        ax.plot(np.repeat(inner, 2), [drop, bar, bar, drop], color="black", linewidth=0.6)
        ax.text(sum(inner) / 2, bar, significance_mark(p), ha="center", va="bottom", fontsize=7)
    ax.set_ylim(low, bar + 0.16 * (high - low))
    if not np.isnan(middle) and far:
        where = "above" if middle > high else "below"
        text = f"{core.system}: {middle:.3g}, {where}"
        ax.text(0.5, 0.02, text, transform=ax.transAxes, ha="center", va="bottom", fontsize=7)


def _shares(
    ax: plt.Axes, preferences: NDArray, objectives: list[str], core: Evaluation | None
) -> None:
    """What the preferences are: their entries, stacked."""
    place = np.arange(len(preferences))
    bottom = np.zeros(len(preferences))
    for entry, objective in enumerate(known(objectives)):
        share = preferences[:, entry]
        ax.bar(place, share, 0.9, bottom, color=objective.color, label=objective.label)
        bottom += share
    if core is not None:
        ax.plot([], [], **_CORE, label=core.system)
    ax.set_ylim(0, 1)
    ax.set_ylabel("weight")
    ax.set_xticks([])
    ax.legend(
        loc="upper center",
        bbox_to_anchor=(0.45, -0.04),
        ncols=len(objectives) + 1,
        frameon=False,
        handlelength=1.2,
        columnspacing=1.2,
    )
    ax.text(-0.145, 1.0, "(e)", transform=ax.transAxes, va="bottom", weight="bold")


def _corner_rows(evaluation: Evaluation) -> list[int]:
    """Places of all preferences with one weight of 1, in their order."""
    return np.flatnonzero((evaluation.preferences == 1).any(1)).tolist()


def _mean_where_any(values: NDArray[np.float64]) -> float:
    return np.nan if np.isnan(values).all() else float(np.nanmean(values))


def _mean_over_seeds(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """``[S, N]`` to ``[N]``, NaN where no seed has a value."""
    defined = ~np.isnan(values)
    count = defined.sum(0)
    total = np.where(defined, values, 0.0).sum(0)
    return np.divide(total, count, out=np.full(count.shape, np.nan), where=count > 0)
