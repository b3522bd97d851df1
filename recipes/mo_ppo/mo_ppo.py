"""MO-PPO: one policy for all preferences, learned on its own episodes, from nothing or from a policy.

PPO (https://arxiv.org/abs/1707.06347) whose critic has one value per objective; the advantages are
weighed by the preference of their episode. Run it with ``python -m recipes.mo_ppo.mo_ppo
policy=FOLDER``, or with ``preset=nothing``; every field of ``config.yaml`` can be overridden on the
command line.
"""

from __future__ import annotations

import copy

import torch
import tqdm
from omegaconf import DictConfig
from torchrl._utils import timeit
from torchrl.collectors import Collector
from torchrl.envs import RewardScaling

from recipes.training import command
from recipes.training.agent import make_actor, make_averaged
from recipes.training.checkpoint import Checkpoints, CollectorState, Counters, check_frames_left
from recipes.training.corners import evaluate_corners
from recipes.training.logs import (
    announce,
    crossed,
    log_metrics,
    make_loggers,
    time_shares,
    warn_if_failing,
)
from recipes.training.optimizers import step
from recipes.training.pictures import trajectories_picture
from recipes.training.policies import finish, save_training_policy
from recipes.training.run_folder import write_run_info
from recipes.training.task import make_task
from torchrl_morl.deploy import load_policy

from . import penalties
from .batches import BATCH, failing, failure_rate, make_replay_buffer
from .cloning import clone, clones
from .networks import ENVS_AT_ONCE, make_advantage, make_critic, make_loss, make_policy
from .optimizers import lmbda, make_optimizers, make_schedule, noise
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
    advantage = make_advantage(cfg, task, critic)
    loss = make_loss(cfg, noisy, critic)
    averaged = make_averaged(cfg, actor)
    optimizers = make_optimizers(cfg, loss)
    replay_buffer = make_replay_buffer(cfg, task)
    precision = torch.autocast(task.device.type, torch.bfloat16, enabled=task.facts["bfloat16"])
    env = task.env.append_transform(RewardScaling(0.0, cfg.replay_buffer.reward_scale))
    tunable = task.preference_space.tunable
    demo = tunable.index("demo") if "demo" in tunable else None
    # What it started as, if that is worth keeping: the anchor holds it where the style is preferred.
    has_style = cfg.policy is not None or clones(cfg)
    anchored = demo is not None and has_style and cfg.loss.anchor_coeff > 0
    start = copy.deepcopy(actor).requires_grad_(False) if anchored else None
    # A clone knows the style alone, and that where nothing else is wished.
    shown = task.preference_space.corners()[demo].to(task.device) if clones(cfg) else None

    collector = Collector(
        env,
        policy,
        frames_per_batch=cfg.collector.frames_per_batch,
        total_frames=cfg.collector.total_frames,
        policy_device=task.device,
        storing_device=task.device,
        auto_register_policy_transforms=False,
    )
    # The learning rate falls from frame `begin` on: 0, unless a training that was over goes on.
    count = Counters(frames=0, begin=0)
    checkpoints = Checkpoints(
        task.run_dir / "checkpoints",
        loss=loss,
        advantage=advantage,
        averaged=averaged,
        **optimizers,
        collector=CollectorState(collector, policy),
        count=count,
        **({} if start is None else {"start": start}),
    )
    if cfg.resume is not None:
        checkpoints.load()
        check_frames_left(cfg, count.frames)
    schedule = make_schedule(cfg, optimizers["actor"], count.frames, count.begin)
    # Nothing is written before the configuration has been accepted.
    write_run_info(task.run_dir)
    loggers = make_loggers(cfg, task.run_dir, begin=count.frames)
    announce(cfg, task.run_dir)

    progress = tqdm.tqdm(
        total=cfg.collector.total_frames, initial=count.frames, unit="step", smoothing=0.05
    )
    done = count.frames // cfg.collector.frames_per_batch
    for batches, data in enumerate(command.until_stopped(collector), start=done):
        collected, frames = count.frames, count.frames + data.numel()
        count.frames = frames
        progress.update(data.numel())
        # The critic starts from nothing: the actor waits until it has learned the values.
        trains_actor = batches >= cfg.optim.critic_batches
        advantage.lmbda.fill_(lmbda(cfg, collected) if trains_actor else 1.0)
        # Advantages of every objective, weighed by the preference of the episode.
        with timeit("advantage"):
            advantage(data)
            if start is not None:
                data["start_action"] = penalties.start_action(
                    cfg, start, data, envs_at_once=ENVS_AT_ONCE, preference=shown
                )
            data["fails"] = failing(data)
        replay_buffer.empty()
        replay_buffer.extend(data.reshape(-1).select(*BATCH, strict=False))

        metrics = {}
        for _ in range(cfg.optim.epochs if trains_actor else cfg.optim.critic_epochs):
            for batch in replay_buffer:
                with timeit("update"):
                    with precision:
                        losses = loss(batch)
                    step(optimizers["critic"], losses["loss_critic"], cfg.optim.max_grad_norm)
                    if trains_actor:
                        # Penalties are smooth: a part of the batch, which is shuffled, will do.
                        part = batch[: cfg.optim.penalty_batch_size]
                        with precision:
                            costs = penalties.compute(
                                cfg, part, actor, sigma=sigma, demo=demo if anchored else None
                            )
                        loss_actor = losses["loss_objective"]
                        for name, cost in costs.items():
                            loss_actor = loss_actor + cfg.loss[f"{name}_coeff"] * cost
                        step(optimizers["actor"], loss_actor, cfg.optim.max_grad_norm)
                        averaged.update_parameters(actor)
                        metrics |= costs
                metrics |= losses
        if trains_actor:
            schedule.step()
        # Constant within a batch: likelihoods are compared under the noise that it was collected with.
        sigma.copy_(noise(cfg, frames))
        metrics["failed"] = failure_rate(data)
        logged = {f"train/{name}": value.detach().mean() for name, value in metrics.items()}
        log_metrics(loggers, logged, frames)

        last = frames >= cfg.collector.total_frames
        if last or crossed(cfg.evaluation.interval, collected, frames):
            with timeit("evaluate"):
                result = evaluate_corners(cfg, task, averaged.module)
            log_metrics(loggers, result.metrics, frames)
            save_training_policy(
                task.run_dir / "policies" / f"{frames:09d}",
                cfg,
                averaged.module,
                task,
                result,
                **({"start": facts} if facts else {}),
            )
            trajectories_picture(
                task.run_dir / "pictures" / f"{frames:09d}.png",
                task,
                result,
                frames=frames,
                goal_radius=cfg.env.goal_radius,
            )
            tqdm.tqdm.write(result.table(frames))
            # What goes on from the end has a schedule of its own.
            count.begin = frames if last else count.begin
            # Behind the small policy, which a full disk must not cost.
            with timeit("checkpoint"):
                checkpoints.save(frames)
            progress.set_postfix(success=f"{result.success:.0f}%", score=f"{result.score:.2f}")
    progress.close()
    if command.stop_requested() and count.frames < cfg.collector.total_frames:
        checkpoints.save(count.frames)
        raise command.Stopped(f"after {count.frames:,} steps")
    collector.shutdown()
    print(time_shares())
    warn_if_failing(result.success)
    finish(task.run_dir, cfg)


if __name__ == "__main__":
    main()
