"""What learners work on: a configuration, random transitions, and a task of the recipe's sizes."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path
from unittest import mock

import torch
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDict

from recipes.training.replay import TRANSITION
from recipes.training.task import Task, make_preference_space, make_train_env
from torchrl_morl.deploy.features import OBSERVATION_SIZE
from torchrl_morl.preferences import PreferenceSpace

from .learner_base import ACTION_SIZE

RECIPES = Path(__file__).resolve().parents[1] / "recipes"
PD_MORL, MO_PPO = "recipes.pd_morl.pd_morl", "recipes.mo_ppo.mo_ppo"

UPDATES = 10
"""Of a turn: a multiple of every policy delay, so that each turn is the same work."""

# Neither what the peers lack nor what they do otherwise.
EQUAL_WORK = (
    "network.critic_layer_norm=false",
    "network.straight_drive=false",
    "loss.angle=null",
    "loss.angle_coeff_actor=0",
    "loss.angle_coeff_critic=0",
    "loss.pre_tanh_coeff=0",
    "optim.actor_average=null",
)


def config(*overrides: str) -> DictConfig:
    """The recipe's configuration with a few fields changed, as on its command line.

    Batches are drawn for 10 updates at a time instead of the recipe's number, which makes turns equal.
    """
    # Hydra's own section holds a date that only Hydra can fill in.
    cfg = OmegaConf.load(RECIPES / "pd_morl" / "config.yaml")
    del cfg["hydra"]
    fields = [f"optim.updates_per_batch={UPDATES}", *overrides]
    return OmegaConf.merge(cfg, OmegaConf.from_dotlist(fields))


def run_recipe(module: str, *overrides: str) -> None:
    """``python -m module overrides`` in this process, where the parts of it can be watched."""
    loaded = sys.modules.pop(module, None)  # runpy warns where there is one
    try:
        with mock.patch.object(sys, "argv", [module, *overrides]):
            # Its own module is the main one, as a recipe expects of its command.
            runpy.run_module(module, run_name="__main__", alter_sys=True)
    finally:
        if loaded is not None:
            sys.modules[module] = loaded


def make_task(cfg: DictConfig, preference_space: PreferenceSpace | None = None) -> Task:
    """For the factories of :mod:`recipes.training`: nothing is trained, evaluated or written.

    Its environment knows no demonstrations, whatever the objectives: the factories ask it for the
    bounds of actions alone.
    """
    env = make_train_env(cfg, make_preference_space(with_demonstrations=False), None)
    return Task(
        run_dir=Path(),
        device=torch.device(cfg.device),
        preference_space=preference_space or make_preference_space(with_demonstrations=True),
        env=env,
        eval_env=env,
        reward_model=None,
        demo_card=None,
        demonstration=None,
        scenes=TensorDict(batch_size=[0]),
    )


def transitions(number: int, seed: int = 0) -> TensorDict:
    """Random transitions of the sizes of the navigation task."""
    preference_space = make_preference_space(with_demonstrations=True)
    generator = torch.Generator().manual_seed(seed)

    def normal(size: int) -> torch.Tensor:
        return torch.randn(number, size, generator=generator)

    preference = preference_space.sample(number, generator=generator)
    ends = torch.rand(number, 1, generator=generator) < 0.01
    data = TensorDict(
        observation=normal(OBSERVATION_SIZE),
        preference=preference,
        action=normal(ACTION_SIZE).tanh(),
        next=TensorDict(
            observation=normal(OBSERVATION_SIZE),
            preference=preference.clone(),
            reward=10 * normal(preference_space.num_objectives),
            done=ends,
            terminated=ends.clone(),
            truncated=torch.zeros_like(ends),
            batch_size=number,
        ),
        batch_size=number,
    )
    return data.select(*TRANSITION)
