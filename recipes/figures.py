"""Figures of preference sweeps and of a preference changed on the way."""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from tensordict import TensorDict
from torch import Tensor

from envs import HUMAN_RADIUS, NavigationEnv
from torchrl_morl.evaluation import PREFERENCE_COLORS, draw_paths, draw_scene

from .sweep import Sweep


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


def sweep_figure(
    path: Path, showcase: Sweep, statistics: Sweep, *, first: str, second: str, goal_radius: float
) -> None:
    """Paths from ``first`` to ``second`` in the showcase and three random scenes, with statistics."""
    share = statistics.preferences[:, statistics.space.tunable.index(second)]
    fig = plt.figure(figsize=(14, 7.6), layout="constrained")
    left, right = fig.subfigures(1, 2, width_ratios=[1.5, 1])
    above, below = left.subfigures(2, 1, height_ratios=[1.35, 1])

    main = above.subplots()
    _scene(main, showcase.scenes[0], goal_radius)
    draw_paths(main, showcase.paths["position"][:, 0], showcase.paths["mask"][:, 0], share)
    main.set_title(f"One policy, {len(share)} preferences: from {first} to {second}")
    bar = above.colorbar(ScalarMappable(Normalize(0, 1), PREFERENCE_COLORS), ax=main, pad=0.01)
    bar.set_label(f"weight of {second}\n(the rest on {first})")

    metrics = statistics.metrics
    count = metrics.shape[1]
    for ax, name, label in zip(
        below.subplots(1, 2),
        ("min_human_distance", "time"),
        ("smallest distance to the human / m", "time to the goal / s"),
        strict=True,
    ):
        values = np.asarray(metrics[name].float())
        low, middle, high = np.nanpercentile(values, [25, 50, 75], axis=1)
        ax.fill_between(share, low, high, alpha=0.25, color="#0072b2", label="middle half")
        ax.plot(share, np.nanmean(values, axis=1), "o-", color="#0072b2", label="mean")
        ax.plot(share, middle, "--", color="0.4", label="median")
        ax.set_xlabel(f"weight of {second}")
        ax.set_ylabel(label)
        ax.grid(alpha=0.3)
        ax.legend(fontsize=8, loc="upper left")
    success = 100 * metrics["success"].float().mean()
    below.suptitle(
        f"{count} random scenes a preference, success {success:.1f} % "
        f"(n = {metrics['success'].numel():,})",
        fontsize=10,
    )

    scenes = min(3, count)
    for index, ax in enumerate(right.subplots(scenes, 1, squeeze=False)[:, 0]):
        _scene(ax, statistics.scenes[index], goal_radius)
        draw_paths(
            ax,
            statistics.paths["position"][:, index],
            statistics.paths["mask"][:, index],
            share,
            linewidth=1.2,
        )
        ax.set_title(f"random scene {index + 1}", fontsize=10)
    fig.savefig(path, dpi=110)
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
    where = np.asarray(paths["position"][-1, switch_step])
    ax.plot(*where, "X", markersize=11, color="#cc79a7", label="preference changes", zorder=6)
    ax.legend(loc="upper left", fontsize=9)
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
