"""Rewards that the preference parameterises: vectors in the replay buffer, scalars in its samples."""

from __future__ import annotations

import torch
from omegaconf import DictConfig
from torchrl.data import TensorDictReplayBuffer
from torchrl.envs import UnaryTransform

from recipes.training import replay
from recipes.training.task import Task
from torchrl_morl.transforms import ScalarizeReward

from .core import CoreSpace


def make_replay_buffer(cfg: DictConfig, task: Task) -> TensorDictReplayBuffer:
    """A buffer of vector rewards, which adds ``scalar_reward`` to what is sampled.

    In a :class:`CoreSpace` sampled preferences are zero, for :func:`.core.cut_off_preference`.
    """
    replay_buffer = replay.make_replay_buffer(cfg, task)
    if isinstance(task.preference_space, CoreSpace):
        keys = ["preference", ("next", "preference")]
        zero = UnaryTransform(in_keys=keys, out_keys=keys, fn=torch.zeros_like)
        replay_buffer.append_transform(zero)
    replay_buffer.append_transform(ScalarizeReward(task.preference_space))
    return replay_buffer
