"""What the PD-MORL script is made of: factories first, then logging."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
import tqdm
from omegaconf import DictConfig
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, EnvBase, RewardScaling
from torchrl.modules import AdditiveGaussianModule
from torchrl.record.loggers import Logger, get_logger

from envs import NavigationEnv
from envs.policy_env import make_policy_env, observation_size
from envs.straight_drive import StraightDriveValue
from torchrl_morl.data import load_demonstrations
from torchrl_morl.deploy import load_reward_model
from torchrl_morl.modules import (
    PreferenceInterpolator,
    RewardModel,
    make_actor,
    make_vector_critic,
)
from torchrl_morl.objectives import MOTD3Loss
from torchrl_morl.preferences import PreferenceSpace
from torchrl_morl.transforms import PreferenceRelabel, PreferenceSampler, RewardModelReward

TRANSITION = (
    "observation",
    "preference",
    "action",
    *(
        ("next", key)
        for key in ("observation", "preference", "reward", "done", "terminated", "truncated")
    ),
)
"""What the replay buffer keeps."""


def load_demonstration_objective(cfg: DictConfig) -> tuple[RewardModel, dict] | None:
    """The reward model that adds the objective "demo", and its card; ``None`` without one."""
    folder = cfg.demonstrations.reward_model
    if folder is None and cfg.demonstrations.get("dataset") is not None:
        raise ValueError(
            "demonstrations.dataset needs demonstrations.reward_model: without one there is no "
            'objective "demo" for them.'
        )
    if folder is None:
        return None
    model, card = load_reward_model(folder)
    size = model.in_features - 2 * ("action" in model.in_keys)
    check_observation(cfg, folder, size)
    return model, card


def check_observation(cfg: DictConfig, source: str, size: int) -> None:
    """Refuse what was made with another observation than the one of this training."""
    expected = observation_size(cfg.env)
    if size != expected:
        raise ValueError(
            f"{source} is about observations of {size} entries, here they have {expected}: both "
            "recipes must be given the same env.observe_human and env.observe_human_velocity."
        )


def make_preference_space(with_demonstrations: bool) -> PreferenceSpace:
    """The core objective always counts once; the user weighs the others."""
    core, *others = NavigationEnv.objectives
    names = (core, *(["demo"] if with_demonstrations else []), *others)
    return PreferenceSpace(names, static={core: 1.0})


def make_train_env(
    cfg: DictConfig, preference_space: PreferenceSpace, reward_model: RewardModel | None
) -> EnvBase:
    sampler = PreferenceSampler(
        preference_space,
        distribution=cfg.preference.distribution,
        num_segments=cfg.preference.num_segments,
        seed=cfg.seed,
    )
    return make_policy_env(sampler, reward_model=reward_model, seed=cfg.seed, **cfg.env)


def make_eval_env(
    cfg: DictConfig, preference_space: PreferenceSpace, reward_model: RewardModel | None
) -> EnvBase:
    sampler = PreferenceSampler(preference_space)
    return make_policy_env(sampler, reward_model=reward_model, **evaluation_arguments(cfg))


def evaluation_arguments(cfg: DictConfig) -> dict[str, Any]:
    """Of :func:`make_policy_env`: the training's own but for the scenes."""
    changed = cfg.evaluation
    return {
        **cfg.env,
        "num_envs": changed.episodes,
        "scene": changed.scene,
        "seed": changed.seed,
        "repeat_failed": 0.0,
    }


def make_policy(
    cfg: DictConfig, env: EnvBase, preference_space: PreferenceSpace, device: torch.device
) -> tuple[TensorDictSequential, TensorDictSequential]:
    """The actor, and the actor followed by exploration noise, which is its last module."""
    spec = env.action_spec_unbatched
    actor = make_actor(
        spec,
        in_features=observation_size(cfg.env) + preference_space.num_tunable,
        num_cells=cfg.network.num_cells,
        device=device,
    )
    noise = AdditiveGaussianModule(
        spec=spec,
        sigma_init=cfg.collector.exploration_sigma,
        sigma_end=cfg.collector.final_exploration_sigma,
        annealing_num_steps=cfg.collector.total_frames,
        device=device,
    )
    return actor, TensorDictSequential(actor, noise)


def make_critic(
    cfg: DictConfig,
    env: EnvBase,
    preference_space: PreferenceSpace,
    num_values: int,
    device: torch.device,
) -> TensorDictModule:
    action_size = env.action_spec_unbatched.shape[-1]
    return make_vector_critic(
        num_values,
        in_features=observation_size(cfg.env) + preference_space.num_tunable + action_size,
        num_cells=cfg.network.num_cells,
        layer_norm=cfg.network.critic_layer_norm,
        device=device,
    )


def make_straight_drive_value(
    cfg: DictConfig, preference_space: PreferenceSpace
) -> StraightDriveValue:
    return StraightDriveValue(
        preference_space.objectives,
        gamma=cfg.loss.gamma,
        reward_scale=cfg.replay_buffer.reward_scale,
        robot=cfg.env.robot,
        goal_radius=cfg.env.goal_radius,
    )


def add_straight_drive(
    critic: TensorDictModule, value: nn.Module, in_keys: list[str]
) -> TensorDictSequential:
    """A critic whose network learns only what is left of the values."""
    (key,) = critic.out_keys
    return TensorDictSequential(
        critic,
        TensorDictModule(value, in_keys=in_keys, out_keys=["straight_drive_value"]),
        TensorDictModule(torch.add, in_keys=[key, "straight_drive_value"], out_keys=[key]),
    )


def make_loss(
    cfg: DictConfig,
    env: EnvBase,
    preference_space: PreferenceSpace,
    actor: TensorDictModule,
    device: torch.device,
) -> MOTD3Loss:
    spec = env.action_spec_unbatched
    critics = [
        make_critic(cfg, env, preference_space, preference_space.num_objectives, device)
        for _ in range(2)
    ]
    if cfg.network.straight_drive:
        value = make_straight_drive_value(cfg, preference_space)
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
        action_spec=spec,
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
    return loss.to(device)


def pre_tanh_coeff(cfg: DictConfig, frames: int) -> float:
    """Geometric decay from ``pre_tanh_coeff`` to ``final_pre_tanh_coeff``."""
    share = frames / cfg.collector.total_frames
    return cfg.loss.pre_tanh_coeff ** (1 - share) * cfg.loss.final_pre_tanh_coeff**share


def make_replay_buffer(
    cfg: DictConfig, preference_space: PreferenceSpace, device: torch.device, *, batches: int = 1
) -> TensorDictReplayBuffer:
    """A buffer that relabels what it gives out: that many batches a sample."""
    return TensorDictReplayBuffer(
        storage=LazyTensorStorage(cfg.replay_buffer.size, device=device),
        batch_size=batches * cfg.replay_buffer.batch_size,
        transform=Compose(
            RewardScaling(0.0, cfg.replay_buffer.reward_scale, in_keys=[("next", "reward")]),
            PreferenceRelabel(
                preference_space,
                ratio=cfg.preference.relabel_ratio,
                distribution=cfg.preference.relabel_distribution,
                seed=cfg.seed,
            ),
        ),
    )


def prefill(
    cfg: DictConfig,
    replay_buffer: TensorDictReplayBuffer,
    preference_space: PreferenceSpace,
    reward_model: RewardModel,
) -> None:
    """Put demonstrations into the buffer: vector rewards make them experience like any other."""
    data, _ = load_demonstrations(cfg.demonstrations.dataset)
    check_observation(cfg, cfg.demonstrations.dataset, data["observation"].shape[-1])
    data = data[: cfg.demonstrations.prefill]
    data = data[data["mask"]]
    preference = torch.zeros(len(data), preference_space.num_tunable)
    preference[:, preference_space.tunable.index("demo")] = 1.0
    data["preference"] = preference
    data["next", "preference"] = preference.clone()
    data = RewardModelReward(reward_model, position=preference_space.objectives.index("demo"))(data)
    replay_buffer.extend(data.select(*TRANSITION))


# --- logging -----------------------------------------------------------------------------------


def make_loggers(cfg: DictConfig, run_dir: Path) -> list[Logger]:
    return [
        get_logger(backend, logger_name=str(run_dir), experiment_name=f"log_{backend}")
        for backend in cfg.logger.backends
    ]


def log_metrics(loggers: list[Logger], metrics: dict[str, Any], frames: int) -> None:
    for logger in loggers:
        for name, value in metrics.items():
            logger.log_scalar(name, float(value), step=frames)


def log_training(
    loggers: list[Logger],
    metrics: dict[str, Tensor],
    preference_space: PreferenceSpace,
    frames: int,
    updates: int,
) -> None:
    flat = {"train/updates": updates}
    for name, value in metrics.items():
        if name == "q_scale":
            for objective, scale in zip(preference_space.objectives, value, strict=True):
                flat[f"train/q_scale/{objective}"] = scale
        else:
            flat[f"train/{name}"] = value.float().mean()
    log_metrics(loggers, flat, frames)


def progress_line(
    progress: tqdm.tqdm, updates: int, success: float, score: float
) -> dict[str, str]:
    """Beside steps/s and the time left, which the bar itself shows."""
    elapsed = progress.format_dict["elapsed"]
    return {
        "updates/s": f"{updates / max(elapsed, 1e-9):.1f}",
        "success": f"{success:.0f}%",
        "score": f"{score:.2f}",
    }


def crossed(interval: int, before: int, after: int) -> bool:
    """Whether a multiple of the interval lies in (before, after]."""
    return after // interval > before // interval
