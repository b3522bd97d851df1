"""PD-MORL: one TD3 agent with vector values, trained over all preferences at once.

Method of Basaklar et al. (https://arxiv.org/abs/2208.07914) as used by de Heuvel et al.
(https://arxiv.org/abs/2404.04857). Run it with ``python -m recipes.pd_morl.pd_morl``; every field of
``config.yaml`` can be overridden on the command line.
"""

from __future__ import annotations

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torch import Tensor
from torchrl._utils import timeit
from torchrl.objectives import SoftUpdate

from recipes.training import off_policy
from recipes.training.agent import make_averaged, make_policy
from recipes.training.command import recipe
from recipes.training.corner_evaluation import CornerEvaluation
from recipes.training.corners import CornerResult
from recipes.training.gradients import make_gradients
from recipes.training.loss import make_loss, pre_tanh_coeff
from recipes.training.optimizers import make_optimizers
from recipes.training.replay import make_replay_buffer
from recipes.training.task import make_task

from .schema import Config


@recipe("config", Config)
def main(cfg: DictConfig) -> None:
    """Train, evaluate while training, and save the last and the best policy."""
    task = make_task(cfg)

    # The agent: an actor and twin critics that read the preference, one value per objective.
    actor, policy = make_policy(cfg, task)
    loss = make_loss(cfg, task, actor)
    critic_gradients, actor_gradients = make_gradients(cfg, loss)
    target_updater = SoftUpdate(loss, eps=cfg.optim.polyak)
    averaged = make_averaged(cfg, actor)
    optimizers, schedulers = make_optimizers(cfg, loss)
    # Sampling replaces the preference of most transitions (hindsight).
    replay_buffer = make_replay_buffer(cfg, task)

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

    def refit_interpolator(result: CornerResult) -> None:
        # The returns at the corner preferences are its key solutions.
        loss.interpolator.refit(result.key_solutions, cfg.evaluation.refit_momentum)

    off_policy.train(
        cfg,
        task,
        policy,
        averaged,
        replay_buffer,
        update,
        schedulers,
        state={"loss": loss, "averaged": averaged, **optimizers, **schedulers},
        evaluation=CornerEvaluation(cfg, task),
        after_updates=decay_pre_tanh_penalty,
        after_evaluation=refit_interpolator,
    )


if __name__ == "__main__":
    main()
