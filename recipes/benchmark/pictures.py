"""Fronts as pictures: two objectives on a plane, three in space, any number as parallel coordinates."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from torchrl_morl.evaluation import PREFERENCE_COLORS, non_dominated

from .fronts import Front

_MARKERS = "osD^vP*X<>"


def draw_fronts(
    fronts: Mapping[str, Front], path: Path, *, title: str = "", discounted: bool = False
) -> None:
    """Draw fronts of one environment, by name.

    Two objectives: a plane. Three: space, and parallel coordinates. More: parallel coordinates.
    Colours are the weight of the first objective; where there are several fronts, each has a colour.

    Args:
        fronts: of the same objectives.
        path: file to write; its folder is made.

    Keyword Args:
        title: above the picture.
        discounted: whether discounted returns are drawn.
    """
    (objectives,) = {front.objectives for front in fronts.values()}
    size = len(objectives)
    panels = {2: ["plane"], 3: ["space", "parallel"]}.get(size, ["parallel"])
    wide = 2.2 + 1.6 * size
    widths = [wide if panel == "parallel" else 5.4 for panel in panels]
    fig = plt.figure(figsize=(sum(widths) + 0.8, 4.8), layout="constrained")
    grid = fig.add_gridspec(1, len(panels), width_ratios=widths)
    values = {name: front.values(discounted=discounted) for name, front in fronts.items()}
    colors = _colors(fronts)
    for place, panel in enumerate(panels):
        ax = fig.add_subplot(grid[place], projection="3d" if panel == "space" else None)
        draw = {"plane": _plane, "space": _space, "parallel": _parallel}[panel]
        draw(ax, objectives, values, colors)
    _key(fig, fronts, colors)
    fig.suptitle(title)
    path.parent.mkdir(parents=True, exist_ok=True)
    fig.savefig(path, dpi=110)
    plt.close(fig)


def _colors(fronts: Mapping[str, Front]) -> dict[str, NDArray[np.float64]]:
    """A colour for every point, ``[P, 4]``."""
    if len(fronts) == 1:
        ((name, front),) = fronts.items()
        return {name: matplotlib.colormaps[PREFERENCE_COLORS](front.preferences[:, 0])}
    palette = matplotlib.colormaps["tab10"]
    return {
        name: np.tile(palette(index % 10), (len(front.preferences), 1))
        for index, (name, front) in enumerate(fronts.items())
    }


def _plane(ax: Axes, objectives, values, colors) -> None:
    for index, (name, points) in enumerate(values.items()):
        best = points[non_dominated(points)]
        best = best[best[:, 0].argsort()]
        # What none dominates, and the corners that it dominates.
        ax.step(*best.T, where="pre", color="0.75" if len(values) == 1 else colors[name][0], lw=1)
        _dots(ax, points, colors[name], index)
    ax.set(xlabel=f"return: {objectives[0]}", ylabel=f"return: {objectives[1]}")
    ax.grid(alpha=0.3)


def _space(ax: Axes, objectives, values, colors) -> None:
    for index, (name, points) in enumerate(values.items()):
        _dots(ax, points, colors[name], index)
    for axis, name in zip((ax.xaxis, ax.yaxis, ax.zaxis), objectives, strict=True):
        axis.set_major_locator(MaxNLocator(4))
        axis.set_tick_params(labelsize=8)
        axis.set_label_text(name)
        axis.labelpad = 8
    ax.view_init(elev=24, azim=-52)
    ax.set_box_aspect(None, zoom=0.82)


def _dots(ax: Axes, points: NDArray, colors: NDArray, index: int) -> None:
    """Full where none dominates it, hollow elsewhere."""
    best = non_dominated(points)
    marker = _MARKERS[index % len(_MARKERS)]
    ax.scatter(*points[best].T, c=colors[best], marker=marker, s=42, zorder=3)
    ax.scatter(
        *points[~best].T, facecolors="none", edgecolors=colors[~best], marker=marker, s=30, zorder=2
    )


def _parallel(ax: Axes, objectives, values, colors) -> None:
    """One upright axis an objective, from the worst to the best return of all fronts."""
    everything = np.concatenate(list(values.values()))
    low, high = everything.min(0), everything.max(0)
    span = np.where(high > low, high - low, 1.0)
    places = np.arange(len(objectives))
    for name, points in values.items():
        best = non_dominated(points)
        for point, color, shown in zip((points - low) / span, colors[name], best, strict=True):
            ax.plot(
                places, point, color=color, lw=1.6 if shown else 0.7, alpha=1.0 if shown else 0.5
            )
    for place in places:
        ax.axvline(place, color="0.3", lw=0.8, zorder=0)
        for end, value in ((0.0, low[place]), (1.0, high[place])):
            ax.annotate(
                f"{value:.4g}",
                (place, end),
                xytext=(0, 9 if end else -9),
                textcoords="offset points",
                ha="center",
                va="center",
                fontsize=8,
            )
    ax.set_xticks(places, objectives)
    ax.tick_params(axis="x", pad=14, length=0)
    ax.set_yticks([])
    ax.set(ylim=(-0.02, 1.1), xlim=(-0.35, len(objectives) - 0.65))
    for side in ("top", "right", "left", "bottom"):
        ax.spines[side].set_visible(False)


def _key(fig: Figure, fronts: Mapping[str, Front], colors: Mapping[str, NDArray]) -> None:
    if len(fronts) == 1:
        (front,) = fronts.values()
        scale = ScalarMappable(Normalize(0.0, 1.0), matplotlib.colormaps[PREFERENCE_COLORS])
        label = f"weight of {front.objectives[0]} in the preference"
        fig.colorbar(scale, ax=fig.axes, label=label, shrink=0.8, pad=0.02)
        return
    handles = [
        Line2D([], [], ls="", marker=_MARKERS[index % len(_MARKERS)], color=colors[name][0])
        for index, name in enumerate(fronts)
    ]
    inches = 0.5 + 0.09 * max(map(len, fronts))
    columns = max(1, min(len(fronts), int(fig.get_figwidth() / inches)))
    fig.legend(handles, list(fronts), loc="outside lower center", ncols=columns)
