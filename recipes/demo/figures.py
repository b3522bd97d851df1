"""Figures of preference sweeps and of a preference changed on the way."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from tensordict import TensorDict
from torch import Tensor

from envs import HUMAN_RADIUS, NavigationEnv
from recipes.evaluation.sweep import Sweep
from recipes.objectives import edge_map, known
from torchrl_morl.evaluation import draw_paths, draw_scene


def _scene(ax: plt.Axes, scene: TensorDict, goal_radius: float) -> None:
    draw_scene(
        ax,
        start=scene["start"],
        goal=scene["goal"],
        human=scene["human"],
        boxes=scene["boxes"],
        human_radius=HUMAN_RADIUS,
        goal_radius=goal_radius,
    )


@dataclasses.dataclass(frozen=True)
class Row:
    """A sweep from one objective to another, in the showcase scene and in random ones."""

    first: str
    second: str
    showcase: Sweep
    statistics: Sweep


def sweep_figure(path: Path, rows: list[Row], *, goal_radius: float) -> None:
    """A line of pictures for every sweep: showcase, a random scene, and two statistics."""
    with_demo = rows[0].showcase.demonstration is not None
    fig, axes = plt.subplots(
        len(rows),
        4,
        figsize=(17, 3.6 * len(rows)),
        width_ratios=[1.9, 1.4, 1, 1],
        layout="constrained",
        squeeze=False,
    )
    for line, row in zip(axes, rows, strict=True):
        share = row.statistics.preferences[
            :, row.statistics.preference_space.tunable.index(row.second)
        ]
        cmap = edge_map(row.first, row.second)
        for ax, result, index in ((line[0], row.showcase, 0), (line[1], row.statistics, 0)):
            _scene(ax, result.scenes[index], goal_radius)
            draw_paths(
                ax,
                result.paths["position"][:, index],
                result.paths["mask"][:, index],
                share,
                cmap=cmap,
            )
            if result.demonstration is not None:
                black = result.demonstration[index]
                ax.plot(*black["position"][black["mask"]].T, color="black", linewidth=1.3)
        line[0].set_title(f"from {row.first} to {row.second}")
        line[1].set_title("a random scene")
        bar = fig.colorbar(ScalarMappable(Normalize(0, 1), cmap), ax=line[0], pad=0.01, aspect=12)
        bar.set_label(f"weight of {row.second}")
        metrics = row.statistics.metrics
        for ax, objective in zip(line[2:], known((row.first, row.second)), strict=True):
            if objective.metric not in metrics.keys():
                ax.set_axis_off()
                ax.text(
                    0.5, 0.5, f"no {objective.metric}:\nnobody drives what was shown", ha="center"
                )
                continue
            values = metrics[objective.metric].float()
            # Unlike NumPy's, these know what to say of a policy that never reaches the goal: NaN.
            low, middle, high = values.nanquantile(torch.tensor([0.25, 0.5, 0.75]), dim=1)
            ax.fill_between(
                share, low, high, alpha=0.25, color=objective.color, label="middle half"
            )
            ax.plot(share, values.nanmean(1), "o-", color=objective.color, label="mean")
            ax.plot(share, middle, "--", color="0.4", label="median")
            ax.set_xlabel(f"weight of {row.second}")
            ax.set_ylabel(objective.metric_label)
            ax.grid(alpha=0.3)
            ax.set_title(f"{metrics.shape[1]} random scenes", fontsize=10)
    axes[0, 2].legend(fontsize=8)
    success = torch.cat([row.statistics.metrics["success"].flatten() for row in rows])
    black = ", demonstration in black" if with_demo else ""
    fig.suptitle(
        f"One policy, {len(rows) * len(share)} preferences{black}: "
        f"success {100 * success.float().mean():.1f} % (n = {success.numel():,})"
    )
    fig.savefig(path, dpi=100)
    plt.close(fig)


def switch_figure(
    path: Path,
    paths: TensorDict,
    actions: Tensor,
    scene: TensorDict,
    *,
    names: tuple[str, ...],
    switch_step: int,
    goal_radius: float,
) -> None:
    """Paths with and without a change of preference on the way, and the commands around it.

    Args:
        path: file to write.
        paths: ``[R]``, see :func:`envs.metrics.trajectories`; the last one switches from the
            first one's preference to the second one's.
        actions: ``[R, S, 2]``, m/s and rad/s.
        scene: start, goal, human and boxes.
        names: one per path.
        switch_step: step whose action is the first under the new preference.
        goal_radius: metres.
    """
    dt = NavigationEnv.CONTROL_PERIOD
    colors = ("#e69f00", "#56b4e9", "#000000")
    styles = ("-", "-", "--")
    fig, (ax, turn, apart) = plt.subplots(
        3, 1, figsize=(9, 10), height_ratios=[1.6, 1, 1], layout="constrained"
    )
    _scene(ax, scene, goal_radius)
    time = dt * np.arange(actions.shape[1])
    for index, (name, color, style) in enumerate(zip(names, colors, styles, strict=True)):
        valid = np.asarray(paths["mask"][index])
        position = np.asarray(paths["position"][index])[valid]
        ax.plot(*position.T, color=color, linestyle=style, linewidth=2, label=name)
        length = len(position) - 1
        turn.plot(time[:length], actions[index, :length, 1], color=color, linestyle=style)
    if switch_step < int(paths["mask"][-1].sum()):  # not if its episode had ended
        where = np.asarray(paths["position"][-1, switch_step])
        ax.plot(*where, "X", markersize=11, color="#cc79a7", label="preference changes", zorder=6)
    ax.legend(loc="lower left", fontsize=9)
    turn.set_ylabel("commanded turn rate / rad/s")
    same = paths["mask"][-1] & paths["mask"][0]
    gap = (paths["position"][-1] - paths["position"][0]).norm(dim=-1)[same]
    apart.plot(dt * np.arange(len(gap)), gap, color="black")
    apart.set_ylabel("distance from the path\nwithout the change / m")
    apart.set_xlabel("time / s")
    for panel in (turn, apart):
        panel.axvspan(dt * switch_step, dt * switch_step + 1.0, color="#cc79a7", alpha=0.3)
        panel.set_xlim(dt * switch_step - 3, dt * switch_step + 7)
        panel.grid(alpha=0.3)
    turn.set_title("pink: the first second after the change", fontsize=10)
    fig.savefig(path, dpi=120)
    plt.close(fig)
