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
from torchrl.data import TensorDictReplayBuffer

from . import command, logs
from .checkpoint import BufferState, Checkpoints, Counters, check_frames_left
from .collection import collecting, make_collector
from .diverged import refuse_diverged
from .evaluation import Evaluation, Problem, Result
from .replay import TRANSITION
from .run_folder import write_run_info

Update = Callable[[TensorDictBase, int, int], dict[str, Tensor]]
"""``update(batch, updates, frames)``: one update of an agent, the count of it from 1, frames so far."""


def train(
    cfg: DictConfig,
    problem: Problem,
    policy: TensorDictModule,
    averaged: AveragedModel,
    replay_buffer: TensorDictReplayBuffer,
    update: Update,
    schedulers: dict[str, torch.optim.lr_scheduler.LRScheduler],
    state: dict[str, Any],
    *,
    evaluation: Evaluation,
    after_updates: Callable[[int], None] | None = None,
    after_evaluation: Callable[[Result], None] | None = None,
) -> None:
    """Train an agent and save its policies in the run folder.

    Args:
        cfg: the configuration.
        problem: where and for what it is trained.
        policy: collects. If its last module has a ``step`` to anneal exploration, it is called.
        averaged: the policy that is evaluated and saved.
        replay_buffer: keeps what is collected; a sample of it is for all updates of a batch of frames.
        update: one update of the agent; returns what is logged.
        schedulers: step once a batch of frames.
        state: what a checkpoint holds.

    Keyword Args:
        evaluation: judges the averaged policy, and saves it.
        after_updates: called after those of a batch of frames, with the frames so far.
        after_evaluation: called with its result, before anything is saved.

    Raises:
        Stopped: where somebody has, see :mod:`.command`.
        WorkerLost: if a worker has died or failed; what was learned is saved.
    """
    collector, episodes = make_collector(cfg, problem, policy)
    anneal = getattr(policy[-1], "step", None)
    count = Counters(frames=0, updates=0, **dict.fromkeys(evaluation.shown, float("nan")))
    checkpoints = Checkpoints(
        problem.run_dir / "checkpoints",
        **state,
        replay_buffer=BufferState(replay_buffer),
        collector=episodes,
        count=count,
    )
    if cfg.resume is not None:
        checkpoints.load()
        check_frames_left(cfg, count.frames)
    stream = iter(collector)  # workers begin, before anything is written
    write_run_info(problem.run_dir)
    loggers = logs.make_loggers(cfg, problem.run_dir, begin=count.frames)
    logs.announce(cfg, problem.run_dir)
    progress = tqdm.tqdm(
        total=cfg.collector.total_frames, initial=count.frames, unit="step", smoothing=0.05
    )
    with collecting(collector, checkpoints, count):
        for data in command.until_stopped(stream):
            with timeit("extend"):
                replay_buffer.extend(data.reshape(-1).select(*TRANSITION))
            collected, frames = count.frames, count.frames + data.numel()
            count.frames = frames
            if anneal is not None:
                anneal(data.numel())
            progress.update(data.numel())

            metrics = {}
            if frames > cfg.collector.init_random_frames:
                with timeit("sample"):
                    sample = replay_buffer.sample()
                for batch in sample.split(cfg.replay_buffer.batch_size):
                    count.updates += 1
                    info = update(batch, count.updates, frames)
                    metrics |= {name: value.detach() for name, value in info.items()}
                for scheduler in schedulers.values():
                    scheduler.step()
                refuse_diverged(
                    metrics,
                    f"in the updates before step {frames:,}",
                    f"lower optim.lr, {cfg.optim.lr:g}, or what scales rewards and losses",
                )
                if after_updates is not None:
                    after_updates(frames)

            if metrics and logs.crossed(cfg.logger.interval, collected, frames):
                logs.log_training(loggers, metrics, problem.preference_space, frames, count.updates)
                progress.set_postfix(logs.progress_line(progress, count, evaluation.shown))

            last = frames >= cfg.collector.total_frames
            if count.updates and (last or logs.crossed(cfg.evaluation.interval, collected, frames)):
                with timeit("evaluate"):
                    result = evaluation(averaged.module)
                if after_evaluation is not None:
                    after_evaluation(result)
                for name in evaluation.shown:
                    setattr(count, name, getattr(result, name))
                evaluation.save(averaged.module, result, frames, loggers)
                tqdm.tqdm.write(result.table(frames))
                # Last, so that it is of a whole step; and after the small policy, if the disk is full.
                with timeit("checkpoint"):
                    checkpoints.save(frames)
        progress.close()
        if command.stop_requested() and count.frames < cfg.collector.total_frames:
            checkpoints.save(count.frames)
            raise command.Stopped(f"after {count.frames:,} steps")
    print(logs.time_shares())
    evaluation.end(result)
