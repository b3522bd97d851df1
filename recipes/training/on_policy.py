"""The loop of MO-PPO: collect, estimate advantages, update, evaluate, save."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import torch
import tqdm
from omegaconf import DictConfig
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor
from torch.optim.swa_utils import AveragedModel
from torchrl._utils import timeit
from torchrl.envs import RewardScaling
from torchrl.objectives import ClipPPOLoss

from torchrl_morl.objectives import MultiObjectiveGAE

from . import command, logs, ppo
from .checkpoint import Checkpoints, Counters, check_frames_left
from .collection import collecting, make_collector
from .diverged import refuse_diverged
from .evaluation import Evaluation, Problem
from .gradients import use_bfloat16
from .optimizers import step
from .ppo_optimizers import make_schedule, noise, scheduled
from .run_folder import write_run_info


def train(
    cfg: DictConfig,
    problem: Problem,
    policy: TensorDictModule,
    actor: TensorDictModule,
    averaged: AveragedModel,
    advantage: MultiObjectiveGAE,
    loss: ClipPPOLoss,
    optimizers: dict[str, torch.optim.Optimizer],
    *,
    evaluation: Evaluation,
    sigma: Tensor | None = None,
    read: Sequence[NestedKey] = ppo.TRANSITION,
    prepare: Callable[[TensorDictBase], None] | None = None,
    costs: Callable[[TensorDictBase], dict[str, Tensor]] | None = None,
    measure: Callable[[TensorDictBase], dict[str, Tensor]] | None = None,
    state: Mapping[str, Any] | None = None,
    facts: Mapping[str, Any] | None = None,
) -> None:
    """Train a policy and save what is evaluated in the run folder.

    Args:
        cfg: the configuration.
        problem: where and for what it is trained.
        policy: collects.
        actor: the part of it that is averaged.
        averaged: the policy that is evaluated and saved.
        advantage: of every objective, weighed by the preference of the episode.
        loss: of policy and critic.
        optimizers: "actor" and "critic".

    Keyword Args:
        evaluation: judges the averaged policy, and saves it.
        sigma: standard deviations of the policy, which follow their schedule; ``None`` without one.
        read: what an update reads of a transition.
        prepare: adds to a batch of frames what ``costs`` read, and may change its rewards.
        costs: what the actor pays for beside its returns, on a part of a batch; each is weighed by
            ``cfg.loss.<name>_coeff``.
        measure: of a batch of frames, for the loggers.
        state: more of what a checkpoint holds.
        facts: for the cards of the policies.

    Raises:
        Stopped: where somebody has, see :mod:`.command`.
        WorkerLost: if a worker has died or failed; what was learned is saved.
    """
    replay_buffer = ppo.make_replay_buffer(cfg, problem)
    bfloat16 = use_bfloat16(cfg.compute.bfloat16, problem.device)
    precision = torch.autocast(problem.device.type, torch.bfloat16, enabled=bfloat16)
    scaling = partial(RewardScaling, 0.0, cfg.replay_buffer.reward_scale)
    collector, episodes = make_collector(cfg, problem, policy, transform=scaling)
    # The learning rate falls from frame `begin` on: 0, unless a training that was over goes on.
    count = Counters(frames=0, begin=0)
    checkpoints = Checkpoints(
        problem.run_dir / "checkpoints",
        loss=loss,
        advantage=advantage,
        averaged=averaged,
        **optimizers,
        collector=episodes,
        count=count,
        **(state or {}),
    )
    if cfg.resume is not None:
        checkpoints.load()
        check_frames_left(cfg, count.frames)
    schedule = make_schedule(cfg, optimizers["actor"], count.frames, count.begin)
    if sigma is not None:
        sigma.copy_(noise(cfg, count.frames))
    stream = iter(collector)  # workers begin
    # Nothing is written before the configuration has been accepted.
    write_run_info(problem.run_dir)
    loggers = logs.make_loggers(cfg, problem.run_dir, begin=count.frames)
    logs.announce(cfg, problem.run_dir)

    progress = tqdm.tqdm(
        total=cfg.collector.total_frames, initial=count.frames, unit="step", smoothing=0.05
    )
    done = count.frames // cfg.collector.frames_per_batch
    with collecting(collector, checkpoints, count):
        for batches, data in enumerate(command.until_stopped(stream), start=done):
            collected, frames = count.frames, count.frames + data.numel()
            count.frames = frames
            progress.update(data.numel())
            # The critic starts from nothing: the actor waits until it has learned the values.
            trains_actor = batches >= cfg.optim.critic_batches
            advantage.lmbda.fill_(scheduled(cfg, "lmbda", collected) if trains_actor else 1.0)
            with timeit("advantage"):
                if prepare is not None:
                    prepare(data)
                advantage(data)
            replay_buffer.empty()
            replay_buffer.extend(data.reshape(-1).select(*read, strict=False))

            metrics: dict[str, Tensor] = {}
            for _ in range(cfg.optim.epochs if trains_actor else cfg.optim.critic_epochs):
                for batch in replay_buffer:
                    with timeit("update"):
                        with precision:
                            losses = loss(batch)
                        step(optimizers["critic"], losses["loss_critic"], cfg.optim.max_grad_norm)
                        if trains_actor:
                            loss_actor = losses["loss_objective"]
                            if "loss_entropy" in losses:
                                loss_actor = loss_actor + losses["loss_entropy"]
                            if costs is not None:
                                with precision:
                                    paid = costs(batch)
                                for name, cost in paid.items():
                                    weight = scheduled(cfg, f"{name}_coeff", collected)
                                    loss_actor = loss_actor + weight * cost
                                metrics |= paid
                            step(optimizers["actor"], loss_actor, cfg.optim.max_grad_norm)
                            averaged.update_parameters(actor)
                    metrics |= losses
            refuse_diverged(
                metrics,
                f"in the updates before step {frames:,}",
                f"lower optim.lr, {cfg.optim.lr:g}, or optim.critic_lr, {cfg.optim.critic_lr:g}, or what "
                "scales rewards and losses",
            )
            if trains_actor:
                schedule.step()
            if sigma is not None:
                # Constant within a batch: likelihoods are compared under the noise that it was collected with.
                sigma.copy_(noise(cfg, frames))
            if measure is not None:
                metrics |= measure(data)
            logged = {f"train/{name}": value.detach().mean() for name, value in metrics.items()}
            logs.log_metrics(loggers, logged, frames)

            last = frames >= cfg.collector.total_frames
            if last or logs.crossed(cfg.evaluation.interval, collected, frames):
                with timeit("evaluate"):
                    result = evaluation(averaged.module)
                evaluation.save(averaged.module, result, frames, loggers, **(facts or {}))
                tqdm.tqdm.write(result.table(frames))
                # What goes on from the end has a schedule of its own.
                count.begin = frames if last else count.begin
                # Behind the small policy, which a full disk must not cost.
                with timeit("checkpoint"):
                    checkpoints.save(frames)
                progress.set_postfix(
                    {
                        name: form.format(getattr(result, name))
                        for name, form in evaluation.shown.items()
                    }
                )
        progress.close()
        if command.stop_requested() and count.frames < cfg.collector.total_frames:
            checkpoints.save(count.frames)
            raise command.Stopped(f"after {count.frames:,} steps")
    print(logs.time_shares())
    evaluation.end(result)
