"""The critic of MO-PPO."""

from __future__ import annotations

from omegaconf import DictConfig
from tensordict.nn import TensorDictModule

from recipes.training import ppo
from recipes.training.agent import add_straight_drive, make_straight_drive_value
from recipes.training.task import Task


def make_critic(cfg: DictConfig, task: Task) -> TensorDictModule:
    """One state value per objective; as in PD-MORL what is left of the value of straight driving."""
    value = make_straight_drive_value(cfg, task)
    return add_straight_drive(ppo.make_critic(cfg, task), value, ["observation"])
