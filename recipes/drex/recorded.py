"""Other styles beside recorded demonstrations: which of them are really other ones."""

from __future__ import annotations

import copy
from typing import Any

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torch import Tensor

from envs import NavigationEnv
from envs.demonstrations import Driver, demonstrated_paths
from envs.policy_env import simulated

from .rollouts import frechet


@torch.no_grad()
def distance_from_recorded(
    cfg: DictConfig, driver: Driver, recorded: TensorDictBase, count: int
) -> Tensor:
    """Frechet distance between recorded drives and a driver in their scenes, as if without boxes.

    Args:
        cfg: of the recipe.
        driver: for ``count`` robots, with a radius each or one for all.
        recorded: demonstrations ``[N, T]``; they take turns.
        count: how many drives are compared.

    Returns:
        ``[count]``, metres.
    """
    drives = recorded[torch.arange(count) % len(recorded)]
    start, arguments = started(cfg, drives)
    driver = copy.deepcopy(driver)
    driver.scaled = False
    return frechet(drives, demonstrated_paths(driver, start, **arguments))


def started(cfg: DictConfig, drives: TensorDictBase) -> tuple[TensorDictBase, dict[str, Any]]:
    """Where recorded drives ``[N, T]`` started, as if without boxes.

    Returns:
        Snapshots ``[N]`` of a :class:`~envs.NavigationEnv`, and its arguments.
    """
    arguments = simulated(cfg.env) | {"scene": "empty"}
    env = NavigationEnv(num_envs=len(drives), **arguments)
    start = env.state_spec.zero()
    env.close()
    first = drives[:, 0]
    pose = first["pose"].to(start["qpos"])
    distance, bearing = first["goal"].to(pose).unbind(-1)
    heading = pose[:, 2] + bearing
    ahead = torch.stack((heading.cos(), heading.sin()), dim=-1)
    start["qpos"], start["human_pose"] = pose, first["human_pose"].to(start["human_pose"])
    start["scene", "goal"] = pose[:, :2] + distance.unsqueeze(-1) * ahead
    start["scene", "human_goal"] = start["scene", "goal"].clone()
    return start, arguments
