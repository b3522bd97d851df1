"""A task without a run folder, for the factories of :mod:`recipes.training`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict

from envs.policy_env import make_policy_env
from recipes.training.task import Task
from torchrl_morl import PreferenceSpace


def make_task(preference_space: PreferenceSpace, **changes: Any) -> Task:
    """Of one environment; ``changes`` are other fields of the task."""
    env = make_policy_env(num_envs=1, num_threads=1, seed=0)
    fields = {
        "run_dir": Path(),
        "device": torch.device("cpu"),
        "preference_space": preference_space,
        "env": env,
        "eval_env": env,
        "reward_model": None,
        "demo_card": None,
        "demonstration": None,
        "scenes": TensorDict(batch_size=[0]),
    }
    return Task(**fields | changes)
