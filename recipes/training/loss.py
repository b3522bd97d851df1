"""The loss of PD-MORL, from its configuration."""

from __future__ import annotations

from omegaconf import DictConfig
from tensordict.nn import TensorDictModule

from torchrl_morl.modules import PreferenceInterpolator
from torchrl_morl.objectives import MOTD3Loss

from .agent import add_straight_drive, make_critic, make_straight_drive_value
from .evaluation import Problem


def make_loss(cfg: DictConfig, task: Problem, actor: TensorDictModule) -> MOTD3Loss:
    """Vector-Q TD3 with the angle term."""
    preference_space = task.preference_space
    critics = [make_critic(cfg, task, preference_space.num_objectives) for _ in range(2)]
    if cfg.network.get("straight_drive"):  # of navigation alone
        value = make_straight_drive_value(cfg, task)
        critics = [add_straight_drive(critic, value, ["observation"]) for critic in critics]
    loss = MOTD3Loss(
        actor,
        critics,
        preference_space=preference_space,
        interpolator=PreferenceInterpolator(
            preference_space.corners(),
            identity=not cfg.loss.interpolated,
            value_space=cfg.loss.angle or "normalized",
        ),
        angle=cfg.loss.angle,
        angle_coeff_actor=cfg.loss.angle_coeff_actor,
        angle_coeff_critic=cfg.loss.angle_coeff_critic,
        pre_tanh_coeff=cfg.loss.pre_tanh_coeff,
        action_spec=task.env.action_spec_unbatched,
        policy_noise=cfg.loss.policy_noise,
        noise_clip=cfg.loss.noise_clip,
        loss_function=cfg.loss.loss_function,
        target_selection=cfg.loss.target_selection,
        # One critic after the other: two small ones are no faster side by side, and torch.compile
        # sees a single graph.
        deactivate_vmap=True,
    )
    if cfg.loss.truncation_is_terminal:
        loss.set_keys(terminated="done")
    loss.make_value_estimator(gamma=cfg.loss.gamma)
    return loss.to(task.device)


def pre_tanh_coeff(cfg: DictConfig, frames: int) -> float:
    """Geometric decay from ``pre_tanh_coeff`` to ``final_pre_tanh_coeff``."""
    share = frames / cfg.collector.total_frames
    return cfg.loss.pre_tanh_coeff ** (1 - share) * cfg.loss.final_pre_tanh_coeff**share
