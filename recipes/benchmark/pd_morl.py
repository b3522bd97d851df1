"""PD-MORL: one TD3 agent with vector values, trained over all preferences at once."""

from __future__ import annotations

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torch import Tensor
from torchrl._utils import timeit
from torchrl.objectives import SoftUpdate

from recipes.training import off_policy
from recipes.training.agent import make_averaged, make_policy
from recipes.training.evaluation import Result
from recipes.training.gradients import make_gradients
from recipes.training.loss import make_loss, pre_tanh_coeff
from recipes.training.optimizers import make_optimizers
from recipes.training.replay import make_replay_buffer

from .lattice import LatticeEvaluation
from .problem import BenchmarkProblem


def train(cfg: DictConfig, problem: BenchmarkProblem) -> None:
    """Train as :mod:`recipes.pd_morl.pd_morl` does.

    Raises:
        ValueError: for discrete actions.
    """
    if problem.num_actions is not None:
        raise ValueError(
            f"algorithm=pd_morl needs continuous actions, {cfg.env} has {problem.num_actions} to choose "
            "from: give algorithm=mo_ppo."
        )
    actor, policy = make_policy(cfg, problem)
    loss = make_loss(cfg, problem, actor)
    critic_gradients, actor_gradients = make_gradients(cfg, loss)
    target_updater = SoftUpdate(loss, eps=cfg.optim.polyak)
    averaged = make_averaged(cfg, actor)
    optimizers, schedulers = make_optimizers(cfg, loss)
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
        evaluation=LatticeEvaluation(cfg, problem),
        after_updates=decay_pre_tanh_penalty,
        after_evaluation=refit_interpolator,
    )
