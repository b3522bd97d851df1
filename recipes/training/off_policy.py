"""The loop around an off-policy agent: collect, update, evaluate, save. The agents differ in updates."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
import tqdm
from omegaconf import DictConfig
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torch.optim.swa_utils import AveragedModel
from torchrl._utils import timeit
from torchrl.checkpoint import Checkpoint, CheckpointRotation
from torchrl.collectors import Collector
from torchrl.data import TensorDictReplayBuffer

from . import command, logs
from .corners import CornerResult, evaluate_corners
from .pictures import trajectories_picture
from .policies import finish, save_training_policy
from .replay import TRANSITION
from .run_folder import checkpoint_bytes, require_space, write_run_info
from .task import Task

Update = Callable[[TensorDictBase, int, int], dict[str, Tensor]]
"""``update(batch, updates, frames)``: one update of an agent, the count of it from 1, frames so far."""


def train(
    cfg: DictConfig,
    task: Task,
    policy: TensorDictModule,
    averaged: AveragedModel,
    replay_buffer: TensorDictReplayBuffer,
    update: Update,
    schedulers: dict[str, torch.optim.lr_scheduler.LRScheduler],
    state: dict[str, Any],
    *,
    after_updates: Callable[[int], None] | None = None,
    after_evaluation: Callable[[CornerResult], None] | None = None,
    on_stop: Callable[[int], None] | None = None,
) -> None:
    """Train an agent and save its policies in the run folder.

    Args:
        cfg: the configuration.
        task: what :func:`make_task` made of it.
        policy: collects. If its last module has a ``step`` to anneal exploration, it is called.
        averaged: the policy that is evaluated and saved.
        replay_buffer: keeps what is collected; a sample of it is for all updates of a batch of frames.
        update: one update of the agent; returns what is logged.
        schedulers: step once a batch of frames.
        state: what a checkpoint holds.

    Keyword Args:
        after_updates: called after those of a batch of frames, with the frames so far.
        after_evaluation: called with its result, before anything is saved.
        on_stop: called with the frames so far where somebody has asked the training to stop.

    Raises:
        Stopped: where somebody has, see :mod:`.command`.
    """
    write_run_info(task.run_dir)
    loggers = logs.make_loggers(cfg, task.run_dir)
    logs.announce(cfg, task.run_dir)
    collector = Collector(
        task.env,
        policy,
        frames_per_batch=cfg.collector.frames_per_batch,
        total_frames=cfg.collector.total_frames,
        init_random_frames=cfg.collector.init_random_frames,
        policy_device=task.device,
        storing_device=task.device,
        auto_register_policy_transforms=False,
    )
    checkpoints = CheckpointRotation(
        task.run_dir / "checkpoints", keep_last=1, keep_best=("score", "max")
    )
    anneal = getattr(policy[-1], "step", None)
    frames = updates = 0
    score = success = float("nan")
    progress = tqdm.tqdm(total=cfg.collector.total_frames, unit="step", smoothing=0.05)
    for data in command.until_stopped(collector):
        with timeit("extend"):
            replay_buffer.extend(data.reshape(-1).select(*TRANSITION))
        collected, frames = frames, frames + data.numel()
        if anneal is not None:
            anneal(data.numel())
        progress.update(data.numel())

        metrics = {}
        if frames > cfg.collector.init_random_frames:
            with timeit("sample"):
                sample = replay_buffer.sample()
            for batch in sample.split(cfg.replay_buffer.batch_size):
                updates += 1
                info = update(batch, updates, frames)
                metrics |= {name: value.detach() for name, value in info.items()}
            for scheduler in schedulers.values():
                scheduler.step()
            if after_updates is not None:
                after_updates(frames)

        if metrics and logs.crossed(cfg.logger.interval, collected, frames):
            logs.log_training(loggers, metrics, task.preference_space, frames, updates)
            progress.set_postfix(logs.progress_line(progress, updates, success, score))

        last = frames >= cfg.collector.total_frames
        if updates and (last or logs.crossed(cfg.evaluation.interval, collected, frames)):
            with timeit("evaluate"):
                result = evaluate_corners(
                    cfg, task.eval_env, averaged.module, task.preference_space, task.demonstration
                )
            if after_evaluation is not None:
                after_evaluation(result)
            score, success = result.score, result.success
            logs.log_metrics(loggers, result.metrics, frames)
            # The small policy first: it is what a full disk must not cost.
            folder = task.run_dir / "policies" / f"{frames:09d}"
            save_training_policy(folder, cfg, averaged.module, task, result)
            require_space(task.run_dir, checkpoint_bytes(state))
            checkpoints.save(Checkpoint(**state), step=frames, metadata={"score": score})
            trajectories_picture(
                task.run_dir / "pictures" / f"{frames:09d}.png",
                task,
                result,
                frames=frames,
                goal_radius=cfg.env.goal_radius,
            )
            tqdm.tqdm.write(result.table(frames))
    progress.close()
    collector.shutdown()
    if command.stop_requested() and frames < cfg.collector.total_frames:
        if on_stop is not None:
            on_stop(frames)
        raise command.Stopped(f"after {frames:,} steps")
    print(logs.time_shares())
    logs.warn_if_failing(success)
    finish(task.run_dir, cfg)
