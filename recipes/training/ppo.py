"""The policy, the critic, the advantages, the loss and the batches of MO-PPO."""

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
from torch import Tensor, nn
from torchrl.data import LazyTensorStorage, SamplerWithoutReplacement, TensorDictReplayBuffer
from torchrl.modules import IndependentNormal
from torchrl.objectives import ClipPPOLoss

from torchrl_morl.modules import make_vector_critic
from torchrl_morl.objectives import MultiObjectiveGAE

from .agent import standardized
from .evaluation import Problem, observation_size

TRANSITION = (
    "observation",
    "preference",
    "noisy_action",
    "noisy_action_log_prob",
    "advantage",
    "value_target",
)
"""What the loss reads of a transition."""

ENVS_AT_ONCE = 32
"""Whose steps a network evaluates in one go: layers of whole batches leave the processor's cache, which
takes twice the time."""


class NoiseScale(nn.Module):
    """Standard deviations, which follow their schedule; a buffer that is in no state dict.

    Args:
        sigma: one for each entry of the action, ``[A]``; whoever changes it in place changes the policy.
    """

    def __init__(self, sigma: Tensor) -> None:
        super().__init__()
        self.register_buffer("sigma", sigma, persistent=False)


class _Scale(nn.Module):
    """Reads standard deviations from a module that is not its part: no loss takes them for weights."""

    def __init__(self, noise: NoiseScale) -> None:
        super().__init__()
        self._noise = (noise,)

    def forward(self, action: Tensor) -> Tensor:
        return self._noise[0].sigma.expand_as(action)


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
    noise = NoiseScale(sigma)
    noisy = ProbabilisticTensorDictSequential(
        actor,
        TensorDictModule(_Scale(noise), in_keys=["action"], out_keys=["scale"]),
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
    policy = TensorDictSequential(noisy, bounds)
    # Its own part: collectors in other processes are sent the buffers of the whole.
    policy.noise = noise
    return noisy, policy


def make_critic(cfg: DictConfig, problem: Problem) -> TensorDictModule:
    """One state value per objective."""
    critic = make_vector_critic(
        problem.preference_space.num_objectives,
        in_features=observation_size(problem) + problem.preference_space.num_tunable,
        in_keys=("observation", "preference"),
        num_cells=cfg.network.num_cells,
        layer_norm=cfg.network.critic_layer_norm,
        out_key="state_value",
        device=problem.device,
    )
    return standardized(critic, problem)


def make_advantage(
    cfg: DictConfig, problem: Problem, critic: TensorDictModule
) -> MultiObjectiveGAE:
    """Advantages of every objective, weighed by the preference."""
    gae = MultiObjectiveGAE(
        gamma=cfg.loss.gamma,
        lmbda=cfg.loss.lmbda,
        value_network=critic,
        preference_space=problem.preference_space,
        level_preferences=cfg.loss.level_preferences,
        value_chunk_size=ENVS_AT_ONCE,
        deactivate_vmap=True,
        device=problem.device,
    )
    if cfg.loss.truncation_is_terminal:
        gae.set_keys(terminated="done")
    return gae


def make_loss(
    cfg: DictConfig,
    policy: ProbabilisticTensorDictSequential,
    critic: TensorDictModule,
    *,
    entropy_coeff: float | None = None,
) -> ClipPPOLoss:
    """The clipped loss.

    Args:
        cfg: the configuration.
        policy: writes ``noisy_action`` and its likelihood.
        critic: writes ``state_value``.

    Keyword Args:
        entropy_coeff: of a bonus; ``None`` where the standard deviation is fixed, and so is the entropy.
    """
    loss = ClipPPOLoss(
        policy,
        critic,
        clip_epsilon=cfg.loss.clip_epsilon,
        entropy_bonus=entropy_coeff is not None,
        entropy_coeff=entropy_coeff,
        loss_critic_type="l2",
        normalize_advantage=True,
    )
    loss.set_keys(action="noisy_action", sample_log_prob="noisy_action_log_prob")
    return loss


def make_replay_buffer(cfg: DictConfig, problem: Problem) -> TensorDictReplayBuffer:
    """Gives out one batch of frames, shuffled, in small batches."""
    return TensorDictReplayBuffer(
        storage=LazyTensorStorage(cfg.collector.frames_per_batch, device=problem.device),
        sampler=SamplerWithoutReplacement(drop_last=True),
        batch_size=cfg.optim.batch_size,
    )
