"""What workers of Ray collect beside the process of the training, and what the wires carry.

MO-PPO's batches, without updates: steps per second of one process and of each number of workers, weights
sent before every batch, the ways taking turns. Then bytes of a transition and of the weights, and the
milliseconds that it takes to send them.

Examples::

    python -m benchmarks.workers
    python -m benchmarks.workers --workers 1 2 --num-envs 64 --steps 32 --rounds 5
"""

from __future__ import annotations

import copy
import statistics
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import torch
from hydra import compose, initialize_config_module
from omegaconf import OmegaConf
from tensordict import TensorDict, TensorDictBase
from torch import nn

from recipes.arguments import Parser
from recipes.mo_ppo.start import complete
from recipes.training.agent import make_actor
from recipes.training.cluster import join_cluster
from recipes.training.collection import make_collector
from recipes.training.ppo import make_policy
from recipes.training.task import make_task
from recipes.training.workers import Workers

from .learner import machine
from .output import parse_with_output


def batches(
    workers: int, num_envs: int, steps: int, folder: Path
) -> tuple[Iterator[TensorDictBase], Workers | None, nn.Module]:
    """Batches of one process, ``workers=0``, or of workers; who collects; the policy."""
    fields = [
        "preset=nothing",
        "compute.torch_threads=1",
        "env.num_threads=1",
        f"env.num_envs={num_envs}",
        f"collector.frames_per_batch={num_envs * steps}",
        "collector.total_frames=1_000_000_000",
        f"collector.backend={'ray' if workers else 'direct'}",
        f"collector.num_workers={max(1, workers)}",
        "preference.num_segments=null",
    ]
    with initialize_config_module("recipes.mo_ppo", version_base="1.3"):
        cfg = complete(compose("config", fields), {})
    task = make_task(copy.deepcopy(cfg), folder)
    sigma = torch.tensor(OmegaConf.to_container(cfg.collector.exploration_sigma))
    _, policy = make_policy(make_actor(cfg, task), sigma)
    collector, _ = make_collector(cfg, task, policy)
    return iter(collector), collector if workers else None, policy


def size(data: TensorDictBase) -> int:
    """Bytes of its tensors."""
    return sum(value.numel() * value.element_size() for value in data.values(True, True))


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
    rates: dict[int, list[float]] = {}
    with tempfile.TemporaryDirectory() as folder:
        ways = {
            workers: batches(workers, args.num_envs, args.steps, Path(folder) / str(workers))
            for workers in (0, *args.workers)
        }
        for stream, *_ in ways.values():
            data = next(stream)  # compiles, and fills caches
        for _ in range(args.rounds):
            for workers, (stream, *_) in ways.items():
                start = time.perf_counter()
                data = next(stream)
                rates.setdefault(workers, []).append(data.numel() / (time.perf_counter() - start))
        sending = []
        *_, (_, last, policy) = ways.values()
        for _ in range(args.rounds):
            start = time.perf_counter()
            last.send_weights()
            sending.append(time.perf_counter() - start)
        for _, workers, _ in ways.values():
            if workers is not None:
                workers.shutdown()
    lines = ["| who collects | steps/s | times one process |", "| --- | --- | --- |"]
    for workers, measured in rates.items():
        ratios = [one / other for one, other in zip(measured, rates[0], strict=True)]
        name = f"{workers} worker{'s' * (workers > 1)}" if workers else "one process"
        lines.append(
            f"| {name} | {statistics.median(measured):,.0f} | {statistics.median(ratios):.2f} |"
        )
    weights = TensorDict.from_module(policy)
    lines += [
        "",
        f"A transition: {size(data) / data.numel():.0f} bytes. The weights: {size(weights):,} bytes, "
        f"{1e3 * statistics.median(sending):.0f} ms to {args.workers[-1]} workers.",
    ]
    text = "\n".join(lines) + "\n\n" + machine()
    print(text)
    args.output.parent.mkdir(parents=True, exist_ok=True)
    args.output.write_text(text + "\n")


if __name__ == "__main__":
    main()
