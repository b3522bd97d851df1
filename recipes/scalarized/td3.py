"""TD3-PR: TD3 on a reward that the preference parameterises; and CORE, on the core reward alone.

TD3 (https://arxiv.org/abs/1802.09477) with scalar critics, the baselines of de Heuvel et al.
(https://arxiv.org/abs/2404.04857, sections V-D and V-E). Run it with ``python -m
recipes.scalarized.td3``, and CORE with ``objective=core``; every field of ``td3.yaml`` and
``common.yaml`` can be overridden on the command line.
"""

from __future__ import annotations

from omegaconf import DictConfig
from tensordict import TensorDictBase
from torch import Tensor
from torchrl._utils import timeit
from torchrl.objectives import SoftUpdate

from recipes.training import off_policy
from recipes.training.agent import make_averaged, make_policy
from recipes.training.command import recipe
from recipes.training.corner_evaluation import CornerEvaluation
from recipes.training.optimizers import make_optimizers, step
from recipes.training.task import make_task

from .core import core_only, cut_off_preference
from .losses import make_td3_loss
from .rewards import make_replay_buffer
from .schema import TD3Config


@recipe("td3", TD3Config)
def main(cfg: DictConfig) -> None:
    """Train, evaluate while training, and save the last and the best policy."""
    task = make_task(cfg)
    if cfg.objective == "core":
        task = core_only(task)
    replay_buffer = make_replay_buffer(cfg, task)

    actor, policy = make_policy(cfg, task)
    if cfg.objective == "core":
        cut_off_preference(actor, task.preference_space)
    loss = make_td3_loss(cfg, task, actor)
    target_updater = SoftUpdate(loss, eps=cfg.optim.polyak)
    averaged = make_averaged(cfg, actor)
    optimizers, schedulers = make_optimizers(cfg, loss)

    def update(batch: TensorDictBase, updates: int, frames: int) -> dict[str, Tensor]:
        with timeit("update critic"):
            value_loss, info = loss.value_loss(batch)
            metrics = step(optimizers["critic"], value_loss, cfg.optim.max_grad_norm)
            metrics |= info | {"loss_qvalue": value_loss}
        if updates % cfg.optim.policy_delay == 0:
            with timeit("update actor"):
                actor_loss, info = loss.actor_loss(batch)
                step(optimizers["actor"], actor_loss, cfg.optim.max_grad_norm)
                target_updater.step()
                averaged.update_parameters(actor)
                metrics |= info | {"loss_actor": actor_loss}
        return metrics

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
