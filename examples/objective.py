"""An objective of one's own without editing the checkout: drive straight at the goal."""

import sys

import numpy as np

import envs.objectives
import recipes.objectives
import recipes.pd_morl.pd_morl
from envs import NavigationEnv
from recipes.objectives import Objective


def ahead(task: envs.objectives.Task, before: np.ndarray) -> np.ndarray:
    """A penalty in [-10, 0]: how much of the step did not bring the goal nearer."""
    nearer = np.linalg.norm(task.goal - before, axis=-1) - task.distance[0]
    return task.rewards.style_penalty * np.clip(1 - nearer / 0.1, 0.0, 1.0)


def declare() -> None:
    envs.objectives.OBJECTIVES["ahead"] = ahead
    recipes.objectives.OBJECTIVES["ahead"] = Objective(
        name="ahead",
        label="straight ahead",
        color="#6c757d",
        metric="path_length",
        metric_label="length of the path / m",
        sign=-1,
        column="time",
        goodness=lambda values: values("direct_distance") / values("path_length"),
    )


def main() -> None:
    declare()
    env = NavigationEnv(objectives=("core", "distance", "ahead"), num_envs=4, seed=0)
    rollout = env.rollout(20)
    for name, values in zip(env.objectives, rollout["next", "reward"].unbind(-1)):
        print(f"{name:>10}: mean reward of a step {values.mean():+.2f}")


if __name__ == "__main__":
    if sys.argv[1:]:  # python -m examples.objective preset=quick
        declare()
        sys.argv.append("env.objectives=[core,distance,ahead]")
        recipes.pd_morl.pd_morl.main()
    else:
        main()
