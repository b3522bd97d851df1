"""Experience for one training from several processes, on this machine or on many: workers of Ray.

TorchRL's ``Collector(backend="ray")`` makes an actor of Ray for each worker, with a collector and a part of
the environments. A batch is what one process would collect: as many steps of as many environments, by one
policy. While the learner updates, workers wait, and while they collect, it does.
"""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import os
import socket
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig
from tensordict import TensorDict, TensorDictBase
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import EnvBase, Transform, TransformedEnv

from .cluster import join_cluster
from .evaluation import Problem


class WorkerLost(ConnectionError):
    """A worker has died or failed; what the learner has learned so far is whole."""


class WorkerCollector(Collector):
    """The collector of a worker, which can say where it is, and fail."""

    def __bool__(self) -> bool:
        # Ray asks for it when a call has failed. Without it Python asks for the length, which a collector
        # without end does not have: the process dies, and why it failed is lost.
        return True

    def where(self) -> str:
        """Process and machine."""
        return f"process {os.getpid()} on {socket.gethostname()}"


@dataclasses.dataclass(frozen=True)
class WorkerEnv:
    """Makes the environments of a worker, in its process.

    Args:
        make_env: of a seed and a number of environments, see :class:`~.evaluation.Problem`.
        seed: of the environments, their preferences, and the noise on the actions.
        num_envs: of this worker.
        num_threads: that PyTorch computes with.
        transform: appended to the environment, made anew; ``None`` without one.
    """

    make_env: Callable[[int, int], EnvBase]
    seed: int
    num_envs: int
    num_threads: int
    transform: Callable[[], Transform] | None = None

    def __call__(self) -> TransformedEnv:
        torch.set_num_threads(self.num_threads)
        env = self.make_env(self.seed, self.num_envs)
        # The process is the worker's own: noise comes from its global generator.
        torch.manual_seed(self.seed)
        return env if self.transform is None else env.append_transform(self.transform())


def worker_seed(seed: int, worker: int, frames: int) -> int:
    """The seed of a worker in a training that has, or goes on after, so many frames.

    Args:
        seed: of the training.
        worker: from 0.
        frames: that the training has collected when the workers begin.

    Returns:
        From 0 to ``2**31 - 1``, different for different arguments, but for chance.

    Examples:
        >>> worker_seed(0, 0, 0), worker_seed(0, 1, 0), worker_seed(0, 0, 96)
        (..., ..., ...)
    """
    return int(np.random.SeedSequence([seed, worker, frames]).generate_state(1)[0] >> 1)


class Workers:
    """Batches of frames from workers of Ray; each is collected by the policy as it is then.

    Iterating starts the workers, and :meth:`shutdown` ends them; a cluster that was started for them ends,
    too. The same seed and number of workers give the same batches.

    Args:
        cfg: the configuration.
        problem: where they collect.
        policy: that collects. Workers have a copy on the CPU, which gets its parameters and buffers before
            every batch.

    Keyword Args:
        transform: makes what is appended to the environments.

    Raises:
        ImportError: without Ray.
    """

    def __init__(
        self,
        cfg: DictConfig,
        problem: Problem,
        policy: nn.Module,
        *,
        transform: Callable[[], Transform] | None = None,
    ) -> None:
        try:
            import ray
        except ImportError as error:
            raise ImportError(
                "collector.backend=ray needs Ray: pip install 'ray>=2.50,<3'."
            ) from error
        self.ray, self.cfg, self.problem, self.policy = ray, cfg, problem, policy
        self.transform = transform
        self.frames = 0
        self.names: list[str] = []
        self._collector = None
        self._owns_ray = False

    def __iter__(self) -> Iterator[TensorDictBase]:
        try:
            self._start()
        except BaseException:
            self.shutdown()
            raise
        return self._batches()

    def state_dict(self) -> dict[str, Any]:
        """Frames so far and the policy. Episodes are not in it: they are in other machines."""
        return {"frames": self.frames, "policy": self.policy.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on there, in new episodes, also from one process or another number of workers."""
        self.policy.load_state_dict(state["policy"])
        self.frames = state["frames"]

    def shutdown(self) -> None:
        """End the workers, and the cluster if it was started for them."""
        collector, self._collector = self._collector, None
        try:
            if collector is not None:
                # Workers of a cluster that is gone have ended. What made it go is what is reported.
                with contextlib.suppress(self.ray.exceptions.RayError):
                    collector.shutdown()
        finally:
            if self._owns_ray:
                self.ray.shutdown()
                self._owns_ray = False

    def _batches(self) -> Iterator[TensorDictBase]:
        total, device = self.cfg.collector.total_frames, self.problem.device
        while self.frames < total and self._collector is not None:
            self.send_weights()
            parts = self._all(
                [worker.next.remote() for worker in self._collector.remote_collectors]
            )
            for worker, part in enumerate(parts):
                # Every worker counts its episodes from 0.
                part["collector", "traj_ids"] *= len(parts)
                part["collector", "traj_ids"] += worker
            data = torch.cat(parts).to(device)
            self.frames += data.numel()
            yield data

    def send_weights(self) -> None:
        """Parameters and buffers, once to each machine.

        TorchRL's RayWeightSyncScheme sends them to each worker by a connection of its own, to the address
        that the learner's host name has there, and waits a minute for a worker that is dead.
        """
        weights = TensorDict.from_module(self.policy).data.cpu().clone()
        try:
            reference = self.ray.put(weights)
        except self.ray.exceptions.RayError as error:
            raise WorkerLost(f"the learner {_reason(error)}") from error
        workers = self._collector.remote_collectors
        self._all([worker.update_policy_weights_.remote(reference) for worker in workers])

    def _all(self, references: list) -> list:
        """What every worker returns, in order; the first one that has failed is named."""
        results = []
        for worker, reference in enumerate(references):
            try:
                results.append(self.ray.get(reference))
            except self.ray.exceptions.RayError as error:
                raise WorkerLost(f"{self._name(worker)} {_reason(error)}") from error
        return results

    def _name(self, worker: int) -> str:
        where = f" ({self.names[worker]})" if self.names else ""
        return f"worker {worker + 1} of {self.cfg.collector.num_workers}{where}"

    def _start(self) -> None:
        section = self.cfg.collector
        workers, cpus = section.num_workers, section.worker_cpus
        address = section.ray_address or os.environ.get("RAY_ADDRESS")
        self._owns_ray = join_cluster(address, workers, cpus) or self._owns_ray
        envs = self.problem.env.batch_size.numel() // workers
        makers = [
            WorkerEnv(
                self.problem.make_env,
                worker_seed(self.cfg.seed, worker, self.frames),
                envs,
                cpus,
                self.transform,
            )
            for worker in range(workers)
        ]
        # Of the whole training; those that are left, as workers count from 0.
        random_frames = max(0, section.get("init_random_frames", 0) - self.frames)
        settings = {
            "collector_class": WorkerCollector,
            "collector_kwargs": {"auto_register_policy_transforms": False},
            "remote_configs": {"num_cpus": cpus},
            "weight_sync_schemes": {},
        }
        try:
            self._collector = Collector(
                makers,
                copy.deepcopy(self.policy).to("cpu"),
                backend="ray",
                num_collectors=workers,
                sync=True,
                frames_per_batch=section.frames_per_batch,
                total_frames=-1,
                init_random_frames=random_frames,
                backend_options=settings,
            )
        except self.ray.exceptions.RayError as error:
            raise WorkerLost(f"a worker {_reason(error)}") from error
        remote = self._collector.remote_collectors
        self.names = self._all([worker.where.remote() for worker in remote])


def _reason(error: Exception) -> str:
    """Why a worker is gone, and what to do about it, in one line.

    Args:
        error: one of ``ray.exceptions.RayError``.
    """
    from ray import exceptions

    name = type(error).__name__
    if cause := getattr(error, "cause", None):
        return f"has failed: {type(cause).__name__}: {' '.join(str(cause).split())}"
    if getattr(error, "actor_init_failed", False):
        return f"has not begun: {str(error).strip().splitlines()[-1].strip()}"
    if isinstance(error, exceptions.ActorUnavailableError):
        return "cannot be reached: its machine or the network is gone"
    if isinstance(error, exceptions.RayActorError | exceptions.WorkerCrashedError):
        return "has died: killed, out of memory, or its machine is gone"
    if isinstance(error, exceptions.ObjectLostError):
        return f"has lost what it was sending ({name}): a machine is gone or cut off"
    if isinstance(
        error,
        exceptions.ObjectStoreFullError | exceptions.OutOfDiskError | exceptions.OutOfMemoryError,
    ):
        return (
            f"has failed ({name}): a machine is out of memory or disk, free some or take a smaller "
            "collector.frames_per_batch"
        )
    what = (str(error).strip().splitlines() or ["no reason given"])[0]
    return f"has failed ({name}: {what}): start the cluster of Ray anew"
