"""Who collects the frames of a training: its own process, or workers of Ray."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

from omegaconf import DictConfig
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.envs import Transform

from .checkpoint import Checkpoints, CollectorState, Counters
from .evaluation import Problem
from .workers import WorkerLost, Workers


def make_collector(
    cfg: DictConfig,
    problem: Problem,
    policy: TensorDictModule,
    *,
    transform: Callable[[], Transform] | None = None,
) -> tuple[Collector | Workers, CollectorState | Workers]:
    """What gives batches of frames, ``[E, T]``, and what a checkpoint holds of it.

    Args:
        cfg: the configuration.
        problem: where frames are collected.
        policy: that collects.

    Keyword Args:
        transform: makes what is appended to the environments.

    Raises:
        ImportError: for Ray where it is not installed.
    """
    # Scalarised agents have no such field.
    if cfg.collector.get("backend", "direct") == "ray":
        workers = Workers(cfg, problem, policy, transform=transform)
        return workers, workers
    env = problem.env if transform is None else problem.env.append_transform(transform())
    collector = Collector(
        env,
        policy,
        frames_per_batch=cfg.collector.frames_per_batch,
        total_frames=cfg.collector.total_frames,
        init_random_frames=cfg.collector.get("init_random_frames"),
        policy_device=problem.device,
        storing_device=problem.device,
        auto_register_policy_transforms=False,
    )
    return collector, CollectorState(collector, policy)


@contextlib.contextmanager
def collecting(
    collector: Collector | Workers, checkpoints: Checkpoints, count: Counters
) -> Iterator[None]:
    """The block in which a training takes its batches; behind it nobody collects any more.

    A worker that is lost costs the batch that it was collecting: what has been learned is saved.

    Args:
        collector: that gives them.
        checkpoints: of the training.
        count: its ``frames``.
    """
    try:
        yield
    except WorkerLost as error:
        if not count.frames:
            raise
        checkpoints.save(count.frames)
        raise WorkerLost(f"{error}; {count.frames:,} steps are saved") from error
    finally:
        collector.shutdown()
