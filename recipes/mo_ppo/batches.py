"""Batches of frames: what an update reads of them, and which episodes in them fail."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from recipes.training import ppo

BATCH = (
    *ppo.TRANSITION,
    "start_action",
    "human",
    "fails",
    ("next", "observation"),
    ("next", "done"),
)
"""What an update reads of a transition."""


def failed(data: TensorDictBase) -> Tensor:
    """Which steps end an episode, and not at the goal, ``[E, T, 1]``."""
    return data["next", "done"] & ~data["next", "success"]


def failure_rate(data: TensorDictBase) -> Tensor:
    """Share of the episodes ending in a batch that do not end at the goal; NaN where none ends."""
    return failed(data).sum() / data["next", "done"].sum()


def failing(data: TensorDictBase) -> Tensor:
    """Which steps belong to an episode that ends in this batch, and not at the goal, ``[E, T]``."""
    episode = data["collector", "traj_ids"]
    return torch.isin(episode, episode[failed(data).squeeze(-1)])
