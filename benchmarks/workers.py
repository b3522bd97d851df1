"""What workers of Ray collect beside the process of the training, and what the wires carry.

MO-PPO's batches, without updates: steps per second of one process and of each number of workers, weights
sent before every batch, the ways taking turns. On a busy machine read the seconds on a processor: a batch
takes those of the slowest worker and of the learner, one after the other. Then bytes of a transition and of
the weights.

Examples::

    python -m benchmarks.workers
    python -m benchmarks.workers --workers 1 2 --num-envs 64 --steps 32 --rounds 5
"""

from __future__ import annotations

import copy
import os
import statistics
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import torch
from tensordict import TensorDict, TensorDictBase
from torch import nn

from recipes.arguments import Parser
from recipes.training.agent import make_actor
from recipes.training.cluster import join_cluster
from recipes.training.collection import make_collector
from recipes.training.ppo import make_policy
from recipes.training.task import make_task
from recipes.training.workers import Workers

from .learner import machine
from .output import parse_with_output
from .workload import config


def batches(
    workers: int, num_envs: int, steps: int, folder: Path
) -> tuple[Iterator[TensorDictBase], Workers | None, nn.Module]:
    """Batches of one process, ``workers=0``, or of workers; who collects; the policy."""
    cfg = config(
        f"env.num_envs={num_envs}",
        f"collector.frames_per_batch={num_envs * steps}",
        "collector.init_random_frames=0",
        "collector.total_frames=1_000_000_000",
        f"collector.backend={'ray' if workers else 'direct'}",
        f"collector.num_workers={max(1, workers)}",
        "preference.num_segments=null",
        "env.scene=static",
    )
    task = make_task(copy.deepcopy(cfg), folder)
    _, policy = make_policy(make_actor(cfg, task), torch.tensor([0.05, 0.15]))
    collector, _ = make_collector(cfg, task, policy)
    return iter(collector), collector if workers else None, policy


def size(data: TensorDictBase) -> int:
    """Bytes of its tensors."""
    return sum(value.numel() * value.element_size() for value in data.values(True, True))


def cpu_seconds(collector: Workers | None) -> list[float]:
    """Seconds on a processor so far: of this process, and of each worker on this machine."""
    spent = [time.process_time()]
    for name in collector.names if collector is not None else ():
        # Fields 14 and 15 of proc(5), behind the name in brackets.
        fields = Path(f"/proc/{name.split()[1]}/stat").read_text().rpartition(")")[2].split()
        spent.append((int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK"))
    return spent


def main(arguments: list[str] | None = None) -> None:
    """Measure; ``--help`` lists the options."""
    parser = Parser(prog="workers", description=__doc__)
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2], help="of Ray")
    parser.add_argument("--num-envs", type=int, default=512, help="all of them")
    parser.add_argument("--steps", type=int, default=64, help="of each environment in a batch")
    parser.add_argument("--rounds", type=int, default=5, help="batches of each way")
    args = parse_with_output(parser, arguments, "workers.md")
    if min(args.rounds, args.steps, args.num_envs, *args.workers) < 1:
        parser.error("--rounds, --steps, --num-envs and --workers must be at least 1.")

    join_cluster(None, sum(args.workers), 1)
    wall: dict[int, list[float]] = {}
    cpu: dict[int, list[list[float]]] = {}
    with tempfile.TemporaryDirectory() as folder:
        ways = {
            workers: batches(workers, args.num_envs, args.steps, Path(folder) / str(workers))
            for workers in (0, *args.workers)
        }
        for stream, *_ in ways.values():
            data = next(stream)  # compiles, and fills caches
        for _ in range(args.rounds):
            for workers, (stream, collector, _) in ways.items():
                before, start = cpu_seconds(collector), time.perf_counter()
                data = next(stream)
                wall.setdefault(workers, []).append(time.perf_counter() - start)
                after = cpu_seconds(collector)
                cpu.setdefault(workers, []).append([b - a for a, b in zip(before, after)])
        for _, collector, _ in ways.values():
            if collector is not None:
                collector.shutdown()
    text = "\n".join([*table(wall, cpu, data.numel()), "", sizes(data, ways[0][2]), "", machine()])
    print(text)
    args.output.parent.mkdir(parents=True, exist_ok=True)
    args.output.write_text(text + "\n")


def table(wall: dict[int, list[float]], cpu: dict[int, list[list[float]]], steps: int) -> list[str]:
    """Rows; the last column is what processors that nobody else uses would bring."""
    lines = [
        "| who collects | steps/s | times one process | CPU, learner | CPU, slowest worker | "
        "times one process, a core each |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    one = statistics.median(own for (own,) in cpu[0])
    for workers, seconds in wall.items():
        times = statistics.median(b / a for a, b in zip(seconds, wall[0], strict=True))
        learner = statistics.median(own for own, *_ in cpu[workers])
        slowest = statistics.median(max(each, default=0.0) for _, *each in cpu[workers])
        name = f"{workers} worker{'s' * (workers > 1)}" if workers else "one process"
        lines.append(
            f"| {name} | {steps / statistics.median(seconds):,.0f} | {times:.2f} | "
            f"{1e6 * learner / steps:.1f} | {1e6 * slowest / steps:.1f} | "
            f"{one / (learner + slowest):.2f} |"
        )
    return lines


def sizes(data: TensorDictBase, policy: nn.Module) -> str:
    """What the wires carry."""
    weights = size(TensorDict.from_module(policy))
    return (
        f"CPU in seconds a million steps. A transition has {size(data) / data.numel():.0f} bytes, the "
        f"weights {weights:,}."
    )


if __name__ == "__main__":
    main()
