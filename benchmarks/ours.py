"""The update of this project, as the recipe of PD-MORL does it."""

from __future__ import annotations

from omegaconf import DictConfig
from tensordict import TensorDict, TensorDictBase
from torchrl.objectives import SoftUpdate

from recipes.training.agent import make_averaged, make_policy
from recipes.training.gradients import make_gradients
from recipes.training.loss import make_loss
from recipes.training.optimizers import make_optimizers
from recipes.training.replay import make_replay_buffer

from .learner_base import TD3Learner
from .workload import make_task


class Ours(TD3Learner):
    """The update of ``recipes.pd_morl``, out of the factories that the recipe calls."""

    def __init__(self, cfg: DictConfig, data: TensorDict) -> None:
        super().__init__()
        self.cfg, self.task = cfg, make_task(cfg)
        self.preference_space = self.task.preference_space
        self.policy_delay = cfg.optim.policy_delay
        self.actor, _ = make_policy(cfg, self.task)
        self.loss = make_loss(cfg, self.task, self.actor)
        self.task.env.close()
        self.critic_gradients, self.actor_gradients = make_gradients(cfg, self.loss)
        self.target_updater = SoftUpdate(self.loss, eps=cfg.optim.polyak)
        average = cfg.optim.actor_average is not None
        self.averaged = make_averaged(cfg, self.actor) if average else None
        self.optimizers, _ = make_optimizers(cfg, self.loss)
        self.replay_buffer = make_replay_buffer(cfg, self.task)
        self.replay_buffer.extend(data)
        self.batches: list[TensorDictBase] = []

    def _sample(self) -> None:
        if not self.batches:
            # As the recipe: those of the next updates at once.
            batches = self.replay_buffer.sample()
            self.batches = list(batches.split(self.cfg.replay_buffer.batch_size))
        self.batch = self.batches.pop()

    def _critic_gradients(self) -> None:
        self.info = self.critic_gradients(self.batch)
        self.loss_value = self.info["loss_qvalue"]

    def _critic_step(self) -> None:
        self.optimizers["critic"].step()

    def _actor_gradients(self) -> None:
        self.info = self.actor_gradients(self.batch)
        self.loss_value = self.info["loss_actor"]

    def _actor_step(self) -> None:
        self.optimizers["actor"].step()

    def _follow(self) -> None:
        self.target_updater.step()
        if self.averaged is not None:
            self.averaged.update_parameters(self.actor)
