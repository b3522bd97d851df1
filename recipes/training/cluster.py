"""The cluster of Ray that workers run in: one that is there, or one of our own."""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Mapping
from types import ModuleType
from unittest import mock

from .stopping import stop_signals

PATIENCE = 300.0
"""Seconds in which other programs must have left a cluster the CPUs that the workers reserve."""


def join_cluster(address: str | None, workers: int, cpus: int) -> bool:
    """Join a cluster, or start one on this machine.

    Args:
        address: ``"auto"`` or host and port; ``None`` starts one, with CPUs enough for the workers.
        workers: that are to run there.
        cpus: that each of them reserves.

    Returns:
        Whether the process was in none before, and is to leave it.

    Raises:
        ConnectionError: if there is none at the address, or its CPUs are taken, after :data:`PATIENCE`.
        ValueError: for one with fewer CPUs, where workers would wait forever.
    """
    import ray

    joins = not ray.is_initialized()
    if joins:
        arguments, environment = {"address": address}, {}
        if address is None:
            arguments = {
                "address": "local",
                # Threads of the workers may be more than there are CPUs, as in one process.
                "num_cpus": max(workers * cpus, os.cpu_count() or 1),
                "include_dashboard": False,
                "_node_ip_address": "127.0.0.1",
            }
            # Ray's workers are nice to everybody else: these are half of the training. And a cluster of
            # our own reports nothing to anybody.
            environment = {"RAY_worker_niceness": "0", "RAY_USAGE_STATS_ENABLED": "0"}
        # Ray takes SIGTERM.
        with stop_signals(), mock.patch.dict(os.environ, environment):
            try:
                ray.init(log_to_driver=False, logging_level="error", **arguments)
            except Exception as error:
                # A bare one where its processes have not begun after 30 seconds.
                reason = " ".join(str(error).split())
                where = "on this machine" if address is None else f"at {address}"
                raise ConnectionError(f"no cluster of Ray {where}: {reason}") from error
    try:
        _wait_for_cpus(ray, workers, cpus)
    except (ConnectionError, ValueError):
        if joins:
            ray.shutdown()
        raise
    return joins


def _wait_for_cpus(ray: ModuleType, workers: int, cpus: int) -> None:
    """Refuse a cluster that is too small, and wait for one that is busy: Ray says nothing of either."""
    machines = _cpus(one["Resources"] for one in ray.nodes() if one["Alive"])
    if not machines:
        raise ConnectionError("the cluster of Ray has no machine that answers: start it anew.")
    if _room(machines, cpus) < workers:
        raise ValueError(
            f"collector.num_workers={workers} of collector.worker_cpus={cpus} do not fit into the cluster, "
            f"whose machines have {', '.join(map(str, machines))} CPUs."
        )
    end = time.monotonic() + PATIENCE
    while (room := _room(free := _free_cpus(ray), cpus)) < workers:
        if time.monotonic() > end:
            raise ConnectionError(
                f"the cluster is busy: its machines have {', '.join(map(str, free))} CPUs free after "
                f"{PATIENCE:.0f} seconds, room for {room} of collector.num_workers={workers} with "
                f"collector.worker_cpus={cpus}."
            )
        time.sleep(0.5)


def _free_cpus(ray: ModuleType) -> list[int]:
    """Of each machine. Ray's public functions only know their sum."""
    return _cpus(ray._private.state.available_resources_per_node().values())


def _cpus(machines: Iterable[Mapping[str, float]]) -> list[int]:
    """Of their resources, which lack what a machine has none of."""
    return [int(one.get("CPU", 0)) for one in machines]


def _room(machines: list[int], cpus: int) -> int:
    """Workers that fit: each has its CPUs on one machine."""
    return sum(machine // cpus for machine in machines)
