"""TorchRL's scalar losses, with critics of the size of PD-MORL's."""

from __future__ import annotations

from omegaconf import DictConfig
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import LossModule, SACLoss, TD3Loss

from recipes.training.agent import make_critic
from recipes.training.task import Task


def make_td3_loss(cfg: DictConfig, task: Task, actor: TensorDictSequential) -> TD3Loss:
    loss = TD3Loss(
        actor,
        _make_critics(cfg, task),
        action_spec=task.env.action_spec_unbatched,
        policy_noise=cfg.loss.policy_noise,
        noise_clip=cfg.loss.noise_clip,
        loss_function=cfg.loss.loss_function,
        deactivate_vmap=True,  # a loop over two critics is faster on a CPU
    )
    return _configure(cfg, task, loss)


def make_sac_loss(cfg: DictConfig, task: Task, policy: ProbabilisticActor) -> SACLoss:
    if not cfg.loss.alpha_init > 0:
        raise ValueError(f"loss.alpha_init must be positive, got {cfg.loss.alpha_init}.")
    loss = SACLoss(
        policy,
        _make_critics(cfg, task),
        action_spec=task.env.action_spec_unbatched,
        alpha_init=cfg.loss.alpha_init,
        loss_function=cfg.loss.loss_function,
        deactivate_vmap=True,  # a loop over two critics is faster on a CPU
    )
    return _configure(cfg, task, loss)


def _make_critics(cfg: DictConfig, task: Task) -> list[TensorDictModule]:
    """Two scalar critics: vector critics with a single value."""
    return [make_critic(cfg, task, num_values=1) for _ in range(2)]


def _configure(cfg: DictConfig, task: Task, loss: LossModule) -> LossModule:
    loss.set_keys(reward="scalar_reward")
    if cfg.loss.truncation_is_terminal:
        loss.set_keys(terminated="done")
    loss.make_value_estimator(gamma=cfg.loss.gamma)
    return loss.to(task.device)
