"""PD-MORL: one TD3 agent with vector values, trained over all preferences at once.

Method of Basaklar et al. (https://arxiv.org/abs/2208.07914), on navigation and on any other problem.
"""

from __future__ import annotations

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torch import Tensor
from torchrl._utils import timeit
from torchrl.objectives import SoftUpdate

from . import off_policy
from .agent import make_averaged, make_policy
from .evaluation import Evaluation, Problem, Result
from .gradients import make_gradients
from .loss import make_loss, pre_tanh_coeff
from .optimizers import make_optimizers
from .replay import make_replay_buffer


def train(cfg: DictConfig, problem: Problem, *, evaluation: Evaluation) -> None:
    """Train, evaluate while training, and save the last and the best policy.

    Args:
        cfg: the configuration.
        problem: where and for what it is trained.

    Keyword Args:
        evaluation: judges the policy, and saves it.

    Raises:
        Stopped: where somebody has, see :mod:`.command`.
    """
    # The agent: an actor and twin critics that read the preference, one value per objective.
    actor, policy = make_policy(cfg, problem)
    loss = make_loss(cfg, problem, actor)
    critic_gradients, actor_gradients = make_gradients(cfg, loss)
    target_updater = SoftUpdate(loss, eps=cfg.optim.polyak)
    averaged = make_averaged(cfg, actor)
    optimizers, schedulers = make_optimizers(cfg, loss)
    # Sampling replaces the preference of most transitions (hindsight).
    replay_buffer = make_replay_buffer(cfg, problem)

    def update(batch: TensorDictBase, updates: int, frames: int) -> dict[str, Tensor]:
        if cfg.compute.compile:
            # CUDA graphs may overwrite what those of the last update gave.
            torch.compiler.cudagraph_mark_step_begin()
        with timeit("update critic"):
            metrics = critic_gradients(batch)
            optimizers["critic"].step()
        if updates % cfg.optim.policy_delay == 0:
            with timeit("update actor"):
                metrics |= actor_gradients(batch)
                optimizers["actor"].step()
                target_updater.step()
                averaged.update_parameters(actor)
        return metrics

    def decay_pre_tanh_penalty(frames: int) -> None:
        loss.pre_tanh_coeff = pre_tanh_coeff(cfg, frames)

    def refit_interpolator(result: Result) -> None:
        # The returns at the corner preferences are its key solutions.
        loss.interpolator.refit(result.key_solutions, cfg.evaluation.refit_momentum)

    off_policy.train(
        cfg,
        problem,
        policy,
        averaged,
        replay_buffer,
        update,
        schedulers,
        state={"loss": loss, "averaged": averaged, **optimizers, **schedulers},
        evaluation=evaluation,
        after_updates=decay_pre_tanh_penalty,
        after_evaluation=refit_interpolator,
    )
