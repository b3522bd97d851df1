"""Two workers of Ray for the tests: a navigation task that they collect in."""

from __future__ import annotations

import copy
import importlib.util
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_module
from omegaconf import DictConfig
from tensordict.nn import TensorDictSequential

from recipes.mo_ppo.start import complete
from recipes.training.agent import make_actor
from recipes.training.ppo import make_policy
from recipes.training.task import Task, make_task
from tests._mo_ppo import TINY

needs_ray = pytest.mark.skipif(
    importlib.util.find_spec("ray") is None, reason="Ray is not installed: pip install ray"
)
TWO = ("collector.backend=ray", "collector.num_workers=2", "preference.num_segments=null")


def configuration(*overrides: str) -> DictConfig:
    """Of a tiny MO-PPO from nothing with two workers."""
    with initialize_config_module("recipes.mo_ppo", version_base="1.3"):
        cfg = compose("config", overrides=["preset=nothing", *TINY, *TWO, *overrides])
    return complete(cfg, {})


def task_and_policy(
    cfg: DictConfig, folder: Path
) -> tuple[Task, torch.Tensor, TensorDictSequential, TensorDictSequential]:
    """Where it trains, the standard deviations, the noisy policy, and the one that collects."""
    task = make_task(copy.deepcopy(cfg), folder)
    sigma = torch.tensor([0.2, 0.25])
    noisy, policy = make_policy(make_actor(cfg, task), sigma)
    return task, sigma, noisy, policy
