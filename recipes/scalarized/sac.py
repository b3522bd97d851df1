"""SAC-PR: soft actor-critic on a reward that the preference parameterises.

Soft actor-critic (https://arxiv.org/abs/1812.05905) with a scalar critic, the baseline of de Heuvel
et al. (https://arxiv.org/abs/2404.04857, section V-D). Run it with ``python -m
recipes.scalarized.sac``, and SAC-PR-gamma with ``loss.gamma=0.98``; every field of ``sac.yaml`` and
``common.yaml`` can be overridden on the command line.
"""

from __future__ import annotations

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torch import Tensor
from torchrl._utils import timeit
from torchrl.objectives import SoftUpdate

from recipes.training import off_policy
from recipes.training.agent import make_actor, make_averaged
from recipes.training.command import recipe
from recipes.training.corner_evaluation import CornerEvaluation
from recipes.training.optimizers import make_optimizers, step
from recipes.training.task import make_task

from .losses import make_sac_loss
from .rewards import make_replay_buffer
from .schema import SACConfig
from .stochastic import make_stochastic_policy


@recipe("sac", SACConfig)
def main(cfg: DictConfig) -> None:
    """Train, evaluate while training, and save the deterministic part of the policy."""
    task = make_task(cfg)
    replay_buffer = make_replay_buffer(cfg, task)

    # The actor that is saved and the one that explores are one network: they share the mean.
    actor = make_actor(cfg, task)
    policy = make_stochastic_policy(cfg, task, actor)
    loss = make_sac_loss(cfg, task, policy)
    target_updater = SoftUpdate(loss, eps=cfg.optim.polyak)
    averaged = make_averaged(cfg, actor)
    optimizers, schedulers = make_optimizers(cfg, loss)
    optimizers["alpha"] = torch.optim.Adam([loss.log_alpha], lr=cfg.optim.lr)

    def update(batch: TensorDictBase, updates: int, frames: int) -> dict[str, Tensor]:
        with timeit("update critic"):
            value_loss, info = loss.qvalue_v2_loss(batch)
            metrics = step(optimizers["critic"], value_loss, cfg.optim.max_grad_norm)
            metrics |= info | {"loss_qvalue": value_loss}
        with timeit("update actor"):
            actor_loss, info = loss.actor_loss(batch)
            step(optimizers["actor"], actor_loss, cfg.optim.max_grad_norm)
        with timeit("update temperature"):
            alpha_loss = loss.alpha_loss(info["log_prob"]).mean()
            step(optimizers["alpha"], alpha_loss, cfg.optim.max_grad_norm)
        target_updater.step()
        averaged.update_parameters(actor)
        return metrics | {
            "loss_actor": actor_loss,
            "alpha": loss.log_alpha.exp(),
            "entropy": -info["log_prob"],
        }

    state = {"loss": loss, "averaged": averaged, **optimizers, **schedulers}
    off_policy.train(
        cfg,
        task,
        policy,
        averaged,
        replay_buffer,
        update,
        schedulers,
        state,
        evaluation=CornerEvaluation(cfg, task),
    )


if __name__ == "__main__":
    main()
