"""The networks of a trained agent: actor, exploring policy, vector critic, averaged actor."""

from __future__ import annotations

from typing import TypeVar

import torch
from omegaconf import DictConfig
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn
from torchrl.modules import AdditiveGaussianModule

import torchrl_morl.modules
from envs.policy_env import observed
from envs.straight_drive import StraightDriveValue
from torchrl_morl.modules import make_vector_critic, standardize_inputs

from .evaluation import Problem, observation_size
from .task import Task

Network = TypeVar("Network", bound=TensorDictModuleBase)


def make_actor(cfg: DictConfig, task: Problem) -> TensorDictSequential:
    """The actor: observation and preference to an action in [-1, 1]."""
    actor = torchrl_morl.modules.make_actor(
        task.env.action_spec_unbatched,
        in_features=observation_size(task) + task.preference_space.num_tunable,
        num_cells=cfg.network.num_cells,
        device=task.device,
    )
    return standardized(actor, task)


def standardized(network: Network, task: Problem) -> Network:
    """The network, whose first input is the observation, with the statistics of the task."""
    if task.statistics is not None:
        standardize_inputs(network, *task.statistics)
    return network


def make_policy(
    cfg: DictConfig, task: Problem
) -> tuple[TensorDictSequential, TensorDictSequential]:
    """The actor, and the actor followed by exploration noise, which is its last module."""
    actor = make_actor(cfg, task)
    spec = task.env.action_spec_unbatched
    noise = AdditiveGaussianModule(
        spec=spec,
        sigma_init=cfg.collector.exploration_sigma,
        sigma_end=cfg.collector.final_exploration_sigma,
        annealing_num_steps=cfg.collector.total_frames,
        device=task.device,
    )
    return actor, TensorDictSequential(actor, noise)


def make_critic(cfg: DictConfig, task: Problem, num_values: int) -> TensorDictModule:
    """A critic with so many values of a state, a preference and an action."""
    action_size = task.env.action_spec_unbatched.shape[-1]
    critic = make_vector_critic(
        num_values,
        in_features=observation_size(task) + task.preference_space.num_tunable + action_size,
        num_cells=cfg.network.num_cells,
        layer_norm=cfg.network.critic_layer_norm,
        device=task.device,
    )
    return standardized(critic, task)


def make_straight_drive_value(cfg: DictConfig, task: Task) -> StraightDriveValue:
    """The value of driving straight to the goal, which critics need not learn."""
    return StraightDriveValue(
        task.preference_space.objectives,
        gamma=cfg.loss.gamma,
        reward_scale=cfg.replay_buffer.reward_scale,
        robot=cfg.env.robot,
        observed=observed(cfg.env),
        goal_radius=cfg.env.goal_radius,
        rewards=cfg.env.get("rewards"),
    )


def add_straight_drive(
    critic: TensorDictModule, value: nn.Module, in_keys: list[str]
) -> TensorDictSequential:
    """A critic whose network learns only what is left of the values."""
    (key,) = critic.out_keys
    return TensorDictSequential(
        critic,
        TensorDictModule(value, in_keys=in_keys, out_keys=["straight_drive_value"]),
        TensorDictModule(torch.add, in_keys=[key, "straight_drive_value"], out_keys=[key]),
    )


def make_averaged(cfg: DictConfig, actor: TensorDictModule) -> AveragedModel:
    """The policy that is evaluated and saved."""
    return AveragedModel(
        actor, multi_avg_fn=get_ema_multi_avg_fn(cfg.optim.actor_average), use_buffers=False
    )
