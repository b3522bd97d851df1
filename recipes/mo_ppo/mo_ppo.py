"""MO-PPO: one policy for all preferences, learned on its own episodes, from nothing or from a policy.

PPO (https://arxiv.org/abs/1707.06347) whose critic has one value per objective; the advantages are
weighed by the preference of their episode. Run it with ``python -m recipes.mo_ppo.mo_ppo
policy=FOLDER``, or with ``preset=nothing``; every field of ``config.yaml`` can be overridden on the
command line.
"""

from __future__ import annotations

import copy

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torch import Tensor

from envs.policy_env import motion_limits, observed
from recipes.objectives import EFFICIENCY
from recipes.training import command, on_policy
from recipes.training.agent import make_actor, make_averaged
from recipes.training.corner_evaluation import CornerEvaluation
from recipes.training.ppo import ENVS_AT_ONCE, make_advantage, make_loss, make_policy
from recipes.training.ppo_optimizers import make_optimizers
from recipes.training.task import make_task
from torchrl_morl.deploy import load_policy
from torchrl_morl.deploy.features import observation_parts
from torchrl_morl.transforms import RewardModelReward

from . import latency, penalties
from .batches import BATCH, failing, failure_rate
from .cloning import clone, clones
from .networks import make_critic
from .schema import Config
from .start import check_start, complete


@command.recipe("config", Config)
def main(cfg: DictConfig) -> None:
    """Train a policy, evaluate it on the way, and save what is evaluated."""
    loaded = None
    if cfg.policy is not None:
        loaded = load_policy(cfg.policy, device=cfg.device, check_preferences=False)
    cfg = complete(cfg, {} if loaded is None else loaded.card)
    task = make_task(cfg)
    if loaded is None:
        actor, facts = make_actor(cfg, task), {}
        if cfg.resume is None:
            clone(cfg, task, actor)
    else:
        check_start(cfg, task, loaded.actor, loaded.preference_space)
        actor = copy.deepcopy(loaded.actor).requires_grad_(True)
        # How the policy was trained that it started as.
        facts = {name: loaded.card[name] for name in ("config", "start") if name in loaded.card}

    # The policy is noise around the actor; the noise is all that PPO adds to it.
    sigma = torch.tensor(list(cfg.collector.exploration_sigma), device=task.device)
    noisy, policy = make_policy(actor, sigma)
    critic = make_critic(cfg, task)
    # Advantages of every objective, weighed by the preference of the episode.
    advantage = make_advantage(cfg, task, critic)
    loss = make_loss(cfg, noisy, critic)
    averaged = make_averaged(cfg, actor)
    optimizers = make_optimizers(cfg, loss)
    tunable = task.preference_space.tunable
    demo = tunable.index("demo") if "demo" in tunable else None
    efficiency = tunable.index(EFFICIENCY) if EFFICIENCY in tunable else None
    if penalties.asks_elsewhere(cfg) and (demo is None or efficiency is None):
        raise ValueError(
            "loss.elsewhere_coeff and loss.final_elsewhere_coeff must be 0 without the objectives demo "
            f"and efficiency, got {cfg.loss.elsewhere_coeff} and {cfg.loss.final_elsewhere_coeff}."
        )
    # What it started as, if that is worth keeping: the anchor holds it where the style is preferred.
    has_style = cfg.policy is not None or clones(cfg)
    anchored = demo is not None and has_style and cfg.loss.anchor_coeff > 0
    start = copy.deepcopy(actor).requires_grad_(False) if anchored else None
    # A clone knows the style alone, and that where nothing else is wished.
    shown = task.preference_space.corners()[demo].to(task.device) if clones(cfg) else None

    # Of a style. What a policy reads of its own motion tells how late its commands are.
    parts = observation_parts(**observed(cfg.env))
    judge = next((one for one in task.env.transform if isinstance(one, RewardModelReward)), None)

    def prepare(data: TensorDictBase) -> None:
        if start is not None:
            data["start_action"] = penalties.start_action(
                cfg, start, data, envs_at_once=ENVS_AT_ONCE, preference=shown
            )
        if judge is not None and "motion" in parts:
            late = latency.latency(data, parts, motion_limits(cfg.env))
            done_at = latency.done_at(late, data["collector", "traj_ids"])
            latency.judge_when_done(
                data,
                done_at,
                judge,
                reward_scale=cfg.replay_buffer.reward_scale,
                envs_at_once=ENVS_AT_ONCE,
            )
            if start is not None and shown is not None:  # else it knows that it is late
                data["start_action"] = latency.rows_at(data["start_action"], done_at)
        data["fails"] = failing(data)

    def costs(batch: TensorDictBase) -> dict[str, Tensor]:
        # Penalties are smooth: a part of the batch, which is shuffled, will do.
        part = batch[: cfg.optim.penalty_batch_size]
        return penalties.compute(
            cfg, part, actor, sigma=sigma, demo=demo, anchored=anchored, efficiency=efficiency
        )

    on_policy.train(
        cfg,
        task,
        policy,
        actor,
        averaged,
        advantage,
        loss,
        optimizers,
        evaluation=CornerEvaluation(cfg, task),
        sigma=sigma,
        read=BATCH,
        prepare=prepare,
        costs=costs,
        measure=lambda data: {"failed": failure_rate(data)},
        state={} if start is None else {"start": start},
        facts={"start": facts} if facts else {},
    )


if __name__ == "__main__":
    main()
