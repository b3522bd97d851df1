"""Figures of preference sweeps and of a preference changed on the way.

The colours are those of :data:`recipes.objectives.OBJECTIVES`; what no preference has made is black,
white or grey.
"""

from __future__ import annotations

import dataclasses
import textwrap
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.artist import Artist
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray
from tensordict import TensorDict
from torch import Tensor

from envs import HUMAN_RADIUS, NavigationEnv
from recipes.evaluation.sweep import Sweep
from recipes.objectives import edge_map, known, preference_colors
from torchrl_morl.evaluation import draw_paths, draw_scene

_STYLE = {"font.size": 10, "axes.titlesize": 10, "figure.titlesize": 11, "legend.fontsize": 10}
_BAND = "0.87"

DEMONSTRATION = {"color": "black", "linewidth": 1.4, "dashes": (4, 1.5), "zorder": 3.5}
"""How a demonstrated path is drawn."""


def _scene(ax: plt.Axes, scene: TensorDict, goal_radius: float, marker_scale: float = 1.0) -> None:
    draw_scene(
        ax,
        start=scene["start"],
        goal=scene["goal"],
        human=scene["human"],
        boxes=scene["boxes"],
        human_radius=HUMAN_RADIUS,
        goal_radius=goal_radius,
        marker_scale=marker_scale,
    )


@dataclasses.dataclass(frozen=True)
class Row:
    """A sweep from one objective to another, in the showcase scene and in random ones."""

    first: str
    second: str
    showcase: Sweep
    statistics: Sweep


def sweep_figure(path: Path, rows: list[Row], *, goal_radius: float) -> None:
    """A column of pictures for every sweep: showcase, a random scene, and two statistics.

    Paths and means have the colour of their preference. It is legible at a width of 900 pixels.

    Args:
        path: file to write.
        rows: the sweeps, three beside each other.

    Keyword Args:
        goal_radius: metres.
    """
    columns = min(3, len(rows))
    blocks = -(-len(rows) // columns)
    with plt.rc_context(_STYLE):
        fig, axes = plt.subplots(
            4 * blocks,
            columns,
            figsize=(0.6 + 3.2 * columns, 0.7 + 8.2 * blocks),
            height_ratios=[1.25, 0.8, 1, 1] * blocks,
            layout="constrained",
            squeeze=False,
        )
        for ax in axes.flat:
            ax.set_axis_off()
        for index, row in enumerate(rows):
            block, column = divmod(index, columns)
            _sweep(fig, axes[4 * block : 4 * block + 4, column], row, goal_radius)
        success = torch.cat([row.statistics.metrics["success"].flatten() for row in rows]).float()
        count = sum(len(row.statistics.preferences) for row in rows)
        fig.suptitle(
            f"One policy, {count} preferences: success {100 * success.mean():.1f} % "
            f"(n = {success.numel():,})"
        )
        with_demo = rows[0].showcase.demonstration is not None
        handles = [*scene_legend(demonstration=with_demo), *_statistics_legend()]
        fig.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False)
        fig.savefig(path, dpi=150)
    plt.close(fig)


def _sweep(fig: plt.Figure, axes: NDArray, row: Row, goal_radius: float) -> None:
    """One sweep on four axes below each other."""
    first, second = known((row.first, row.second))
    space, preferences = row.statistics.preference_space, row.statistics.preferences
    share = preferences[:, space.tunable.index(row.second)]
    cmap = edge_map(row.first, row.second)
    for ax, result in zip(axes, (row.showcase, row.statistics), strict=False):
        ax.set_axis_on()
        _scene(ax, result.scenes[0], goal_radius, marker_scale=0.7)
        draw_paths(ax, result.paths["position"][:, 0], result.paths["mask"][:, 0], share, cmap=cmap)
        if result.demonstration is not None:
            black = result.demonstration[0]
            ax.plot(*black["position"][black["mask"]].T, **DEMONSTRATION)
    axes[0].set_title(f"from {first.label} to {second.label}")
    axes[1].set_title("a random scene")
    axes[2].set_title(f"{row.statistics.metrics.shape[1]} random scenes")
    bar = fig.colorbar(
        ScalarMappable(Normalize(0, 1), cmap), ax=axes[0], location="bottom", aspect=30, pad=0.02
    )
    bar.set_ticks([0, 1], labels=[first.label, second.label])
    bar.ax.tick_params(length=0)
    for label, side in zip(bar.ax.get_xticklabels(), ("left", "right"), strict=True):
        label.set_ha(side)
    metrics = row.statistics.metrics
    for ax, objective in zip(axes[2:], (first, second), strict=True):
        if objective.metric not in metrics.keys():
            text = f"no {objective.metric}:\nnobody drives what was shown"
            ax.text(0.5, 0.5, text, ha="center", va="center")
            continue
        ax.set_axis_on()
        values = metrics[objective.metric].float()
        # Unlike NumPy's, these know what to say of a policy that never reaches the goal: NaN.
        low, middle, high = values.nanquantile(torch.tensor([0.25, 0.5, 0.75]), dim=1)
        ax.fill_between(share, low, high, color=_BAND, linewidth=0)
        ax.plot(share, middle, "--", color="0.4")
        ax.plot(share, values.nanmean(1), color="0.4", zorder=2)
        ax.scatter(
            share,
            values.nanmean(1),
            s=36,
            c=preference_colors(preferences, space.tunable),
            edgecolors="black",
            linewidths=0.6,
            zorder=3,
        )
        ax.set_xlabel(f"weight of {second.label}")
        ax.set_ylabel(textwrap.fill(objective.metric_label, 22))
        ax.grid(alpha=0.3)


def scene_legend(*, demonstration: bool) -> list[Line2D]:
    """What is black and white in a scene.

    Keyword Args:
        demonstration: whether a demonstrated path is drawn.
    """
    dot = {"linestyle": "", "color": "black"}
    handles = [
        Line2D([], [], marker="o", markersize=6, label="start", **dot),
        Line2D([], [], marker="*", markersize=10, label="goal", **dot),
        Line2D([], [], marker="o", markersize=9, markerfacecolor="white", label="human", **dot),
    ]
    return handles + [Line2D([], [], label="demonstrated path", **DEMONSTRATION)] * demonstration


def _statistics_legend() -> list[Artist]:
    return [
        Line2D([], [], color="0.4", marker="o", markeredgecolor="black", label="mean"),
        Line2D([], [], color="0.4", linestyle="--", label="median"),
        Patch(color=_BAND, label="middle half of the scenes"),
    ]


def switch_figure(
    path: Path,
    paths: TensorDict,
    actions: Tensor,
    scene: TensorDict,
    *,
    names: tuple[str, str],
    switch_step: int,
    goal_radius: float,
) -> None:
    """Paths with and without a change of preference on the way, and the commands around it.

    Args:
        path: file to write.
        paths: ``[3]``, see :func:`envs.metrics.trajectories`: under the first preference, under the
            second, and under the first and then the second.
        actions: ``[3, S, 2]``, m/s and rad/s.
        scene: start, goal, human and boxes.

    Keyword Args:
        names: of the objectives of the two preferences.
        switch_step: step whose action is the first under the new preference.
        goal_radius: metres.
    """
    dt = NavigationEnv.CONTROL_PERIOD
    first, second = known(names)
    lines = (
        {"color": first.color, "linestyle": "-", "label": first.label},
        {"color": second.color, "linestyle": "-", "label": second.label},
        {"color": "black", "linestyle": "--", "label": f"{first.label}, then {second.label}"},
    )
    with plt.rc_context(_STYLE):
        fig, (ax, turn, apart) = plt.subplots(
            3, 1, figsize=(9, 9.6), height_ratios=[1.7, 1, 1], layout="constrained"
        )
        _scene(ax, scene, goal_radius)
        time = dt * np.arange(actions.shape[1])
        for index, line in enumerate(lines):
            valid = np.asarray(paths["mask"][index])
            position = np.asarray(paths["position"][index])[valid]
            ax.plot(*position.T, linewidth=2.2, **line)
            length = len(position) - 1
            turn.plot(time[:length], actions[index, :length, 1], linewidth=1.8, **line)
        if switch_step < int(paths["mask"][-1].sum()):  # not if its episode had ended
            where = np.asarray(paths["position"][-1, switch_step])
            label = "the preference changes"
            cross = {"markersize": 13, "markeredgecolor": "white", "linestyle": "", "zorder": 6}
            ax.plot(*where, marker="X", color="black", label=label, **cross)
        handles = [*ax.get_legend_handles_labels()[0], *scene_legend(demonstration=False)]
        fig.legend(handles=handles, loc="outside upper center", ncols=4, frameon=False)
        turn.set_ylabel("commanded\nturn rate / rad/s")
        same = paths["mask"][-1] & paths["mask"][0]
        gap = (paths["position"][-1] - paths["position"][0]).norm(dim=-1)[same]
        apart.plot(dt * np.arange(len(gap)), gap, color="black", linewidth=1.8)
        apart.set_ylabel("distance from the path\nwithout the change / m")
        apart.set_xlabel("time / s")
        for panel in (turn, apart):
            panel.axvspan(dt * switch_step, dt * switch_step + 1.0, color=_BAND, zorder=0)
            panel.set_xlim(dt * switch_step - 3, dt * switch_step + 7)
            panel.grid(alpha=0.3)
        turn.set_title("grey: the first second after the change")
        fig.savefig(path, dpi=120)
    plt.close(fig)
