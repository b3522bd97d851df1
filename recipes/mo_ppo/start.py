"""The policy that MO-PPO starts from: what its card adds to the configuration, and whether it fits."""

from __future__ import annotations

from typing import Any

from omegaconf import DictConfig
from tensordict.nn import TensorDictSequential

from recipes.training.task import Task, check_observation
from torchrl_morl.deploy import training_config
from torchrl_morl.preferences import PreferenceSpace


def check(cfg: DictConfig) -> None:
    """What nothing further down would refuse.

    Raises:
        ValueError: for a batch size, a noise or a coefficient that means nothing.
    """
    if cfg.collector.frames_per_batch % cfg.env.num_envs:
        raise ValueError(
            "collector.frames_per_batch must be a multiple of env.num_envs, "
            f"{cfg.env.num_envs}, got {cfg.collector.frames_per_batch}."
        )
    if not 0 < cfg.optim.batch_size <= cfg.collector.frames_per_batch:
        raise ValueError(
            "optim.batch_size must lie between 1 and collector.frames_per_batch, "
            f"{cfg.collector.frames_per_batch}, got {cfg.optim.batch_size}."
        )
    least_of = {"penalty_batch_size": 1, "epochs": 1, "critic_epochs": 1, "critic_batches": 0}
    for name, least in least_of.items():
        if cfg.optim[name] < least:
            raise ValueError(f"optim.{name} must be at least {least}, got {cfg.optim[name]}.")
    sigma = list(cfg.collector.exploration_sigma)
    if len(sigma) != 2 or min(sigma) <= 0:
        raise ValueError(
            "collector.exploration_sigma must be positive, for speed and turn rate, since without "
            f"noise there is nothing to compare, got {sigma}."
        )
    if cfg.loss.anchor_window < 1 or cfg.loss.anchor_window % 2 == 0:
        raise ValueError(
            "loss.anchor_window must be an odd number of steps, 1 for no average, "
            f"got {cfg.loss.anchor_window}."
        )
    for name in ("anchor_coeff", "anchor_radius", "smoothness_coeff", "standing_coeff"):
        if cfg.loss[name] < 0:
            raise ValueError(f"loss.{name} must not be negative, got {cfg.loss[name]}.")


def complete(cfg: DictConfig, card: dict[str, Any]) -> DictConfig:
    """The configuration with what is null in ``env`` and ``evaluation`` taken from the policy's card.

    The scene is that of the policy's evaluations: PD-MORL may have trained in another one.

    Args:
        cfg: as given.
        card: of the policy.

    Raises:
        ValueError: if the card does not tell.
    """
    cfg = cfg.copy()
    evaluation, env = (training_config(card, section) for section in ("evaluation", "env"))
    if "scene" in evaluation:
        env["scene"] = evaluation["scene"]
    for part, trained in {"env": env, "evaluation": evaluation}.items():
        given = {name: value for name, value in cfg[part].items() if value is not None}
        known = {name: trained[name] for name in cfg[part] if name in trained}
        cfg[part] = {**known, **given}
    missing = {"scene", "robot", "goal_radius", "max_episode_steps"} - set(cfg.env)
    if missing:
        raise ValueError(
            f"the card of {cfg.policy} does not say what it was trained in: give "
            + ", ".join(f"env.{name}" for name in sorted(missing))
            + "."
        )
    cfg.evaluation = {"scene": cfg.env.scene, **cfg.evaluation}
    return cfg


def check_start(
    cfg: DictConfig, task: Task, start: TensorDictSequential, preference_space: PreferenceSpace
) -> None:
    """Refuse a policy that does not fit the task.

    Raises:
        ValueError: if it has other objectives, or observes something else.
    """
    if preference_space != task.preference_space:
        raise ValueError(
            f"{cfg.policy} has the objectives {preference_space.objectives}, the task {task.preference_space.objectives}: "
            "demonstrations.reward_model must name the reward model that the policy was trained "
            "with, if there was one."
        )
    check_observation(
        cfg, cfg.policy, start[0].module[0].in_features - preference_space.num_tunable
    )
