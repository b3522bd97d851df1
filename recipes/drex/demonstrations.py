"""Demonstrations: the scripted pattern, or somebody's own."""

from __future__ import annotations

from typing import Any

import torch
import tqdm
from omegaconf import DictConfig
from tensordict import TensorDict, TensorDictBase

from envs import NavigationEnv
from envs.demonstrations import CircleDemonstrator, demonstrated_paths
from envs.policy_env import simulated
from envs.splits import training_seed
from recipes.training.task import check_observation
from torchrl_morl.data import load_demonstrations

from .rollouts import pad, rollouts, succeeded


def read_demonstrations(cfg: DictConfig) -> TensorDictBase | None:
    """Somebody's own demonstrations ``[N, T]``; ``None`` where the scripted ones are asked for.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no file of demonstrations, of another robot, or of another observation.
    """
    path = cfg.demonstrations.dataset
    if path is None:
        return None
    data, metadata = load_demonstrations(path)
    robot = metadata.get("robot") or metadata["config"]["env"]["robot"]
    if robot != cfg.env.robot:
        raise ValueError(
            f"{path} was driven by {robot}, but env.robot is {cfg.env.robot}: set env.robot={robot}, "
            "or import the recordings again with --robot."
        )
    check_observation(cfg, path, data["observation"].shape[-1])
    return data


def collect_demonstrations(cfg: DictConfig) -> TensorDictBase:
    """``N_D`` collision-free rollouts of the scripted pattern in random scenes."""
    kept: list[TensorDictBase] = []
    wanted, seed = cfg.demonstrations.count, cfg.seed
    with tqdm.tqdm(total=wanted, desc="demonstrations", unit="rollout") as progress:
        while progress.n < wanted:
            data = rollouts(demonstrator(cfg), cfg.demonstrations.batch, seed, **cfg.env)
            data = data[succeeded(data)][: wanted - progress.n]
            kept.append(data)
            progress.update(len(data))
            seed += 1
    longest = max(data.shape[1] for data in kept)
    return torch.cat([pad(data, longest) for data in kept])


@torch.no_grad()
def demonstrated(cfg: DictConfig, count: int, seed: int) -> TensorDict:
    """What the demonstrator drives in the scenes of :func:`rollouts`, as if there were no boxes."""
    kwargs = simulated(cfg.env)
    env = NavigationEnv(num_envs=count, seed=training_seed(seed), **kwargs)
    start = env.reset()
    env.close()
    driver = CircleDemonstrator(**demonstrator_arguments(cfg))
    return demonstrated_paths(driver, start, **kwargs)


def demonstrator(cfg: DictConfig, **changes: Any) -> CircleDemonstrator:
    """Drives what is demonstrated, or what differs from it by other arguments."""
    return CircleDemonstrator(**demonstrator_arguments(cfg) | changes, scaled=True)


def demonstrator_arguments(cfg: DictConfig) -> dict[str, Any]:
    """Of :class:`envs.demonstrations.CircleDemonstrator`."""
    section = cfg.demonstrations
    return {
        "radius": section.radius,
        "side": section.side,
        "speed": section.speed,
        "robot": cfg.env.robot,
    }
