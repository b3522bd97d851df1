"""What the MO-PPO script is made of, beside what it shares with PD-MORL."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictSequential,
)
from torch import Tensor, nn
from torchrl.checkpoint import Checkpoint, CheckpointRotation
from torchrl.data import LazyTensorStorage, SamplerWithoutReplacement, TensorDictReplayBuffer
from torchrl.modules import IndependentNormal
from torchrl.objectives import ClipPPOLoss

from envs.policy_env import observation_size
from recipes.pd_morl import files
from recipes.pd_morl import utils as pd_morl
from recipes.pd_morl.evaluation import Evaluation
from recipes.task import Task
from torchrl_morl.modules import make_vector_critic
from torchrl_morl.objectives import MultiObjectiveGAE
from torchrl_morl.preferences import PreferenceSpace

BATCH = (
    "observation",
    "preference",
    "noisy_action",
    "noisy_action_log_prob",
    "advantage",
    "value_target",
    "start_action",
    "human",
    "fails",
    ("next", "observation"),
    ("next", "done"),
)
"""What an update reads of a transition."""

ENVS_AT_ONCE = 32
"""Whose steps a network evaluates in one go: layers of whole batches leave the processor's cache, which
takes twice the time."""


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
    trained_in = card.get("config", {})
    evaluation, env = trained_in.get("evaluation", {}), dict(trained_in.get("env", {}))
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
    pd_morl.check_observation(
        cfg, cfg.policy, start[0].module[0].in_features - preference_space.num_tunable
    )


def resume(cfg: DictConfig, state: Checkpoint) -> tuple[int, int]:
    """Load the last checkpoint of the run that ``resume`` names, if it names one.

    Args:
        cfg: the configuration; what it changes holds from here on.
        state: of what a checkpoint holds.

    Returns:
        How many frames it has seen, and after how many the schedule of the learning rate begins: see
        :func:`make_schedule`.

    Raises:
        FileNotFoundError: if there is no checkpoint.
        ValueError: if nothing is left to be done, or if the checkpoint does not say where it stands.
    """
    if cfg.resume is None:
        return 0, 0
    latest = CheckpointRotation(Path(cfg.resume) / "checkpoints", keep_last=1).latest()
    if latest is None:
        raise FileNotFoundError(
            f"resume={cfg.resume} has no checkpoint: it must be the folder of a run of MO-PPO that "
            "has been evaluated at least once."
        )
    metadata = Checkpoint.manifest(latest)["metadata"]
    if missing := {"frames", "schedule"} - metadata.keys():
        raise ValueError(
            f"resume={cfg.resume}: its checkpoint lacks {sorted(missing)}, as those of earlier "
            "versions do. Go on with the version that wrote it, or start anew."
        )
    frames = metadata["frames"]
    if frames >= cfg.collector.total_frames:
        raise ValueError(
            f"resume={cfg.resume} has seen {frames} frames already: collector.total_frames must be "
            f"greater, got {cfg.collector.total_frames}."
        )
    state.load(latest)
    return frames, metadata["schedule"]


def make_policy(
    actor: TensorDictSequential, sigma: Tensor
) -> tuple[ProbabilisticTensorDictSequential, TensorDictSequential]:
    """A normal variable around the action of an actor, with its own layers.

    Noise on the action and not before its tanh: where the tanh saturates, steps that hardly change
    the action would count as large ones.

    Args:
        actor: writes ``action`` in [-1, 1].
        sigma: standard deviation of each entry, in units of half its range, ``[A]``.

    Returns:
        The probabilistic part, which writes ``noisy_action`` beside the actor's ``action``; and that
        followed by the bounds, which writes ``action`` anew.
    """
    noisy = ProbabilisticTensorDictSequential(
        actor,
        TensorDictModule(sigma.expand_as, in_keys=["action"], out_keys=["scale"]),
        ProbabilisticTensorDictModule(
            in_keys={"loc": "action", "scale": "scale"},
            out_keys=["noisy_action"],
            distribution_class=IndependentNormal,
            return_log_prob=True,
        ),
    )
    bounds = TensorDictModule(
        partial(torch.clamp, min=-1.0, max=1.0), in_keys=["noisy_action"], out_keys=["action"]
    )
    return noisy, TensorDictSequential(noisy, bounds)


def make_critic(cfg: DictConfig, task: Task) -> TensorDictModule:
    """One state value per objective; as in PD-MORL what is left of the value of straight driving."""
    critic = make_vector_critic(
        task.preference_space.num_objectives,
        in_features=observation_size(cfg.env) + task.preference_space.num_tunable,
        in_keys=("observation", "preference"),
        num_cells=cfg.network.num_cells,
        layer_norm=cfg.network.critic_layer_norm,
        out_key="state_value",
        device=task.device,
    )
    value = pd_morl.make_straight_drive_value(cfg, task.preference_space)
    return pd_morl.add_straight_drive(critic, value, ["observation"])


def make_advantage(cfg: DictConfig, task: Task, critic: TensorDictModule) -> MultiObjectiveGAE:
    gae = MultiObjectiveGAE(
        gamma=cfg.loss.gamma,
        lmbda=cfg.loss.lmbda,
        value_network=critic,
        preference_space=task.preference_space,
        level_preferences=cfg.loss.level_preferences,
        value_chunk_size=ENVS_AT_ONCE,
        deactivate_vmap=True,
        device=task.device,
    )
    if cfg.loss.truncation_is_terminal:
        gae.set_keys(terminated="done")
    return gae


def make_loss(
    cfg: DictConfig, policy: ProbabilisticTensorDictSequential, critic: TensorDictModule
) -> ClipPPOLoss:
    loss = ClipPPOLoss(
        policy,
        critic,
        clip_epsilon=cfg.loss.clip_epsilon,
        entropy_bonus=False,  # the standard deviation is fixed, and so is the entropy
        loss_critic_type="l2",
        normalize_advantage=True,
    )
    loss.set_keys(action="noisy_action", sample_log_prob="noisy_action_log_prob")
    return loss


def failed(data: TensorDictBase) -> Tensor:
    """Which steps end an episode, and not at the goal, ``[E, T, 1]``."""
    return data["next", "done"] & ~data["next", "success"]


def failure_rate(data: TensorDictBase) -> Tensor:
    """Share of the episodes ending in a batch that do not end at the goal; NaN where none ends."""
    return failed(data).sum() / data["next", "done"].sum()


def failing(data: TensorDictBase) -> Tensor:
    """Which steps belong to an episode that ends in this batch, and not at the goal, ``[E, T]``."""
    episode = data["collector", "traj_ids"]
    return torch.isin(episode, episode[failed(data).squeeze(-1)])


def make_replay_buffer(cfg: DictConfig, task: Task) -> TensorDictReplayBuffer:
    """Gives out one batch of frames, shuffled, in small batches."""
    return TensorDictReplayBuffer(
        storage=LazyTensorStorage(cfg.collector.frames_per_batch, device=task.device),
        sampler=SamplerWithoutReplacement(drop_last=True),
        batch_size=cfg.optim.batch_size,
    )


def make_optimizers(cfg: DictConfig, loss: ClipPPOLoss) -> dict[str, torch.optim.Optimizer]:
    """Adam for each network."""
    return {
        "actor": torch.optim.Adam(
            loss.actor_network_params.flatten_keys().values(), lr=cfg.optim.lr, fused=True
        ),
        "critic": torch.optim.Adam(
            loss.critic_network_params.flatten_keys().values(), lr=cfg.optim.critic_lr, fused=True
        ),
    }


def make_schedule(
    cfg: DictConfig, optimizer: torch.optim.Optimizer, frames: int, begin: int
) -> torch.optim.lr_scheduler.LambdaLR:
    """Lets the actor's rate fall linearly to a twentieth until the end of the training.

    Args:
        cfg: the configuration; the rate is that of ``optim.lr``, also where the optimizer was loaded.
        optimizer: of the actor.
        frames: how many have been collected already.
        begin: after how many frames it begins to fall: 0, or, of a run that goes on from one that was
            over, those of that one. The rate then falls anew, a warm restart
            (https://arxiv.org/abs/1608.03983).
    """
    size = cfg.collector.frames_per_batch
    batches = -(-(cfg.collector.total_frames - begin) // size)
    waits = cfg.optim.critic_batches if begin == 0 else 0
    done, updates = max(0, (frames - begin) // size - waits), max(1, batches - waits)
    for group in optimizer.param_groups:
        group["lr"] = group["initial_lr"] = cfg.optim.lr
    return torch.optim.lr_scheduler.LambdaLR(
        optimizer, lambda step: 1 - 0.95 * min(1.0, step / updates), last_epoch=done - 1
    )


def save(
    task: Task,
    cfg: DictConfig,
    frames: int,
    actor: TensorDictSequential,
    result: Evaluation,
    card: dict[str, Any],
) -> None:
    """Save a policy whose card also tells how the policy was trained that it started as."""
    files.save_training_policy(
        task.run_dir / "policies" / f"{frames:09d}",
        cfg,
        actor,
        task.preference_space,
        result,
        task.demo_card,
        num_cells=tuple(m.out_features for m in actor[0].module if isinstance(m, nn.Linear))[:-1],
        start={name: card[name] for name in ("config", "start") if name in card},
    )
