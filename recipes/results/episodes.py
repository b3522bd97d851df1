"""From a sweep to one row an episode: every metric of ``docs/metrics.md``."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import Tensor

from envs import HUMAN_RADIUS, NavigationEnv
from envs.robots import get_robot
from envs.scene_files import get_scene
from torchrl_morl import evaluation
from torchrl_morl.evaluation.shortest_path import shortest_path_length

from ..evaluation.setting import GOAL_RADIUS
from ..evaluation.sweep import Sweep
from ..objectives import PERSONAL_SPACE

OUTCOMES = ("success", "collision_human", "collision_obstacle", "timeout")


def episode_values(result: Sweep, *, scene: str, robot: str) -> TensorDict:
    """All metrics of a sweep, one value an episode.

    Args:
        result: with a demonstration.

    Keyword Args:
        scene: kind of the scenes.
        robot: whose radius and speed count.

    Returns:
        ``[P, N]``: what :func:`envs.metrics.episode_metrics` gives and ``frechet``, and

        - ``demonstration_free``: no box stands on the demonstrated path;
        - ``straight_time`` and ``shortest_time``: the straight line, or the shortest way around
          boxes and a standing human, to the edge of the goal at full speed, s;
        - the other metrics of :mod:`torchrl_morl.evaluation`.
    """
    base = get_robot(robot)
    paths, scenes, metrics = result.paths, result.scenes, result.metrics
    position, heading, human, mask = (
        paths[name] for name in ("position", "heading", "human", "mask")
    )
    period, success = NavigationEnv.CONTROL_PERIOD, metrics["success"]
    stands = get_scene(scene).human_speed == 0
    shortest = shortest_path_length(
        scenes["start"],
        scenes["goal"],
        scenes["boxes"],
        radius=base.radius,
        goal_radius=GOAL_RADIUS,
        human=scenes["human"] if stands else None,
        human_radius=HUMAN_RADIUS,
    ).expand(mask.shape[:2])
    straight = (metrics["direct_distance"] - GOAL_RADIUS) / base.max_speed
    radii = {"radius": base.radius, "human_radius": HUMAN_RADIUS}
    goal = scenes["goal"].expand(*mask.shape[:2], 2)
    values: dict[str, Tensor] = {
        **{name: metrics[name] for name in (*OUTCOMES, "time", "frechet")},
        "demonstration_free": result.demonstration["free"].expand(mask.shape[:2]),
        "min_human_distance": metrics["min_human_distance"],
        "min_surface_distance": evaluation.min_surface_distance(position, human, mask, **radii),
        "human_exposure": evaluation.human_exposure(position, human, mask, period, PERSONAL_SPACE),
        "personal_space_compliance": evaluation.personal_space_compliance(position, human, mask),
        "space_violations": evaluation.space_violations(position, human, mask),
        "min_time_to_collision": evaluation.min_time_to_collision(
            position, human, mask, period, **radii
        ),
        "min_clearance": metrics["min_clearance"],
        "path_length": metrics["path_length"],
        "direct_distance": metrics["direct_distance"],
        "shortest_path": shortest,
        "straight_time": straight,
        "shortest_time": shortest / base.max_speed,
        "spl": evaluation.spl(success, position, mask, shortest),
        "stl": evaluation.stl(success, mask, period, shortest / base.max_speed),
        "stalled_time": evaluation.stalled_time(position, mask, period),
        "mean_jerk": evaluation.mean_jerk(position, mask, period),
        "cumulative_heading_change": evaluation.cumulative_heading_change(heading, mask),
        "path_irregularity": evaluation.path_irregularity(position, heading, mask, goal),
    }
    return TensorDict(values, batch_size=mask.shape[:2])


def trajectory_arrays(results: list[Sweep]) -> dict[str, Tensor]:
    """What a picture needs, of one sweep per training seed: plain float32 and bool arrays.

    Returns:
        ``position`` [S, P, N, T, 2], ``heading`` [S, P, N, T], ``human`` [S, P, N, T, 2], ``mask``
        [S, P, N, T], ``preference`` [P, K], ``start`` [N, 3], ``goal`` [N, 2], ``human_start`` [N, 3],
        ``boxes`` [N, M, 5], ``demonstration`` [N, D, 2] and its ``demonstration_mask`` and
        ``demonstration_free`` [N].
    """
    longest = max(result.paths["mask"].shape[-1] for result in results)

    def stacked(name: str) -> Tensor:
        padded = []
        for result in results:
            value = result.paths[name]
            missing = longest - value.shape[2]
            tail = value.new_zeros((*value.shape[:2], missing, *value.shape[3:]))
            padded.append(torch.cat((value, tail), dim=2))
        return torch.stack(padded)

    first = results[0]
    arrays = {name: stacked(name) for name in ("position", "heading", "human", "mask")} | {
        "preference": first.preferences,
        "start": first.scenes["start"],
        "goal": first.scenes["goal"],
        "human_start": first.scenes["human"],
        "boxes": first.scenes["boxes"],
        "demonstration": first.demonstration["position"],
        "demonstration_mask": first.demonstration["mask"],
        "demonstration_free": first.demonstration["free"],
    }
    return {
        name: value.float() if value.is_floating_point() else value
        for name, value in arrays.items()
    }
