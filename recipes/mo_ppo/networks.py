"""The policy, the critic, the advantages and the loss of MO-PPO."""

from __future__ import annotations

from functools import partial

import torch
from omegaconf import DictConfig
from tensordict.nn import (
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictSequential,
)
from torch import Tensor
from torchrl.modules import IndependentNormal
from torchrl.objectives import ClipPPOLoss

from envs.policy_env import observation_size
from recipes.training.agent import add_straight_drive, make_straight_drive_value
from recipes.training.task import Task
from torchrl_morl.modules import make_vector_critic
from torchrl_morl.objectives import MultiObjectiveGAE

ENVS_AT_ONCE = 32
"""Whose steps a network evaluates in one go: layers of whole batches leave the processor's cache, which
takes twice the time."""


def make_policy(
    actor: TensorDictSequential, sigma: Tensor
) -> tuple[ProbabilisticTensorDictSequential, TensorDictSequential]:
    """A normal variable around the action of an actor, with its own layers.

    Noise on the action and not before its tanh: where the tanh saturates, steps that hardly change
    the action would count as large ones.

    Args:
        actor: writes ``action`` in [-1, 1].
        sigma: standard deviation of each entry, in units of half its range, ``[A]``.

    Returns:
        The probabilistic part, which writes ``noisy_action`` beside the actor's ``action``; and that
        followed by the bounds, which writes ``action`` anew.
    """
    noisy = ProbabilisticTensorDictSequential(
        actor,
        TensorDictModule(sigma.expand_as, in_keys=["action"], out_keys=["scale"]),
        ProbabilisticTensorDictModule(
            in_keys={"loc": "action", "scale": "scale"},
            out_keys=["noisy_action"],
            distribution_class=IndependentNormal,
            return_log_prob=True,
        ),
    )
    bounds = TensorDictModule(
        partial(torch.clamp, min=-1.0, max=1.0), in_keys=["noisy_action"], out_keys=["action"]
    )
    return noisy, TensorDictSequential(noisy, bounds)


def make_critic(cfg: DictConfig, task: Task) -> TensorDictModule:
    """One state value per objective; as in PD-MORL what is left of the value of straight driving."""
    critic = make_vector_critic(
        task.preference_space.num_objectives,
        in_features=observation_size(cfg.env) + task.preference_space.num_tunable,
        in_keys=("observation", "preference"),
        num_cells=cfg.network.num_cells,
        layer_norm=cfg.network.critic_layer_norm,
        out_key="state_value",
        device=task.device,
    )
    value = make_straight_drive_value(cfg, task)
    return add_straight_drive(critic, value, ["observation"])


def make_advantage(cfg: DictConfig, task: Task, critic: TensorDictModule) -> MultiObjectiveGAE:
    gae = MultiObjectiveGAE(
        gamma=cfg.loss.gamma,
        lmbda=cfg.loss.lmbda,
        value_network=critic,
        preference_space=task.preference_space,
        level_preferences=cfg.loss.level_preferences,
        value_chunk_size=ENVS_AT_ONCE,
        deactivate_vmap=True,
        device=task.device,
    )
    if cfg.loss.truncation_is_terminal:
        gae.set_keys(terminated="done")
    return gae


def make_loss(
    cfg: DictConfig, policy: ProbabilisticTensorDictSequential, critic: TensorDictModule
) -> ClipPPOLoss:
    loss = ClipPPOLoss(
        policy,
        critic,
        clip_epsilon=cfg.loss.clip_epsilon,
        entropy_bonus=False,  # the standard deviation is fixed, and so is the entropy
        loss_critic_type="l2",
        normalize_advantage=True,
    )
    loss.set_keys(action="noisy_action", sample_log_prob="noisy_action_log_prob")
    return loss
