"""The policy that MO-PPO starts from: what its card adds to the configuration, and whether it fits."""

from __future__ import annotations

from typing import Any

from omegaconf import DictConfig
from tensordict.nn import TensorDictSequential

from envs.policy_env import OBSERVED
from recipes.training.task import Task, check_observation
from torchrl_morl.deploy import training_config
from torchrl_morl.preferences import PreferenceSpace

FROM_NOTHING = {
    "env": {
        "scene": "exploring",
        "robot": "turtlebot2",
        "observe_human": True,
        "observe_human_velocity": False,
        "observe_nobody": False,
        "observe_robot": False,
        "observe_motion": False,
        "drive": "planar",
        "goal_radius": 0.3,
        "max_episode_steps": 300,
        "objectives": ["core", "distance", "efficiency"],
        "rewards": {},
        "faults": {},
    },
    "evaluation": {"scene": "static"},
}
"""What null means without a policy to start from."""


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
    if cfg.policy is None:
        env, evaluation = FROM_NOTHING["env"], FROM_NOTHING["evaluation"]
    else:
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
        cfg, cfg.policy, start[0].module[0].in_features - preference_space.num_tunable, OBSERVED
    )
