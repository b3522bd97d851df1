"""A picture at every evaluation: where the corner preferences drive."""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
from matplotlib.lines import Line2D

from envs import HUMAN_RADIUS
from recipes.objectives import known
from torchrl_morl.evaluation import draw_scene

from .corners import CornerResult
from .task import Task

_SCENES = 4
_BALANCED = "0.45"


def trajectories_picture(
    path: Path, task: Task, result: CornerResult, *, frames: int, goal_radius: float
) -> None:
    """Paths of every evaluated preference in the first scenes, in the colours of the objectives.

    Args:
        path: file to write; its folder is made.
        task: whose scenes they are.
        result: of the evaluation.

    Keyword Args:
        frames: steps so far, for the title.
        goal_radius: metres.
    """
    objectives = known(task.preference_space.tunable)
    colors = [*(objective.color for objective in objectives), _BALANCED]
    count = min(_SCENES, len(task.scenes))
    fig, axes = plt.subplots(
        1, count, figsize=(4.2 * count, 2.9), layout="constrained", squeeze=False
    )
    for index, ax in enumerate(axes[0]):
        scene = task.scenes[index]
        draw_scene(
            ax,
            start=scene["start"],
            goal=scene["goal"],
            human=scene["human"],
            boxes=scene["boxes"],
            human_radius=HUMAN_RADIUS,
            goal_radius=goal_radius,
        )
        if task.demonstration is not None:
            shown = task.demonstration[index]
            ax.plot(*shown["position"][shown["mask"]].T, color="black", linewidth=1, zorder=3)
        for row, color in enumerate(colors):
            driven = result.paths[row, index]
            ax.plot(*driven["position"][driven["mask"]].T, color=color, linewidth=1.8, zorder=3)
    handles = [Line2D([], [], color=one.color, label=one.label) for one in objectives]
    handles.append(Line2D([], [], color=_BALANCED, label="all alike"))
    if task.demonstration is not None:
        handles.append(Line2D([], [], color="black", linewidth=1, label="the demonstrator"))
    fig.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)
    fig.suptitle(f"after {frames:,} steps: {result.success:.0f} % success")
    path.parent.mkdir(parents=True, exist_ok=True)
    fig.savefig(path, dpi=80)
    plt.close(fig)
