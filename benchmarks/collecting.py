"""Whether collecting in processes of its own pays.

PD-MORL: seconds between one batch of frames and the next, updates included, as the recipe is
and with TorchRL's asynchronous collector, which collects the next batch in another process while
the updates run. MO-PPO, whose updates need what the last policy did: seconds to collect a batch of
the recipe's size in this process, two threads for the physics, and in two processes.

The ways take turns, each training in a process of its own, as users run them; nothing is trained to
the end. Further arguments are fields of PD-MORL's configuration.

Examples::

    python -m benchmarks.collecting
    python -m benchmarks.collecting --rounds 1 --frames 9600 compute.compile=false
"""

from __future__ import annotations

import argparse
import functools
import itertools
import multiprocessing
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from unittest import mock

import torch
import tqdm
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDictBase
from torchrl.collectors import Collector, MultiAsyncCollector, MultiSyncCollector
from torchrl.envs import EnvBase

import recipes.mo_ppo
from recipes.mo_ppo import utils as mo_ppo
from recipes.pd_morl import pd_morl, utils
from torchrl_morl.deploy import load_policy
from torchrl_morl.deploy.features import OBSERVATION_SIZE
from torchrl_morl.modules import RewardModel

from .learner import machine
from .learner_systems import ACTION_SIZE, config

POLICY = Path("recipes/policies/recipe_seed0")


def make_env(cfg: DictConfig, *arguments) -> EnvBase:
    """An environment in a process of its own, which has one core."""
    torch.set_num_threads(1)
    cfg = OmegaConf.merge(cfg, {"env": {"num_threads": 1}})
    return utils.make_train_env(cfg, *arguments)


class Clocked:
    """A collector that notes when it hands out each batch."""

    def __init__(self, collector: Iterable[TensorDictBase], times: list[float]) -> None:
        self.collector, self.times = collector, times

    def __iter__(self) -> Iterator[TensorDictBase]:
        for batch in self.collector:
            self.times.append(time.perf_counter())
            yield batch

    def shutdown(self) -> None:
        self.collector.shutdown()


def pd_morl_batch(overlapping: bool, threads: int, frames: int, overrides: list[str]) -> float:
    """Seconds from a batch to the next: the median, to which compiling and evaluations do not matter."""
    times = []

    def collector(env, policy, **settings):
        if not overlapping:
            return Clocked(Collector(env, policy, **settings), times)
        maker = functools.partial(make_env, *makes.call_args.args)
        # The worker gets the latest policy with every batch, as it has it without a process.
        return Clocked(
            MultiAsyncCollector([maker], policy, update_at_each_batch=True, **settings), times
        )

    with tempfile.TemporaryDirectory() as folder:
        command = [
            "pd_morl",
            f"collector.total_frames={frames}",
            f"collector.init_random_frames={config().collector.frames_per_batch}",
            "evaluation.episodes=2",
            f"compute.torch_threads={threads}",
            *overrides,
            f"hydra.run.dir={folder}/run",
        ]
        with (
            mock.patch.object(sys, "argv", command),
            mock.patch.object(utils, "make_train_env", wraps=utils.make_train_env) as makes,
            mock.patch.object(pd_morl, "Collector", collector),
        ):
            pd_morl.main()
    return statistics.median(after - before for before, after in itertools.pairwise(times))


def mo_ppo_collectors(num_envs: int, steps: int) -> dict[str, Collector | MultiSyncCollector]:
    """As in the recipe, with a reward model that has learned nothing: it costs the same."""
    start, preference_space, card = load_policy(POLICY)
    cfg = OmegaConf.load(Path(recipes.mo_ppo.__file__).parent / "config.yaml")
    del cfg["hydra"]
    cfg.policy = str(POLICY)
    cfg.env.num_envs = num_envs
    cfg = mo_ppo.complete(cfg, card)
    reward_model = RewardModel(in_features=OBSERVATION_SIZE + ACTION_SIZE)
    sigma = torch.tensor(list(cfg.collector.exploration_sigma))
    settings = {
        "frames_per_batch": num_envs * steps,
        "total_frames": -1,
        "auto_register_policy_transforms": False,
    }
    half = OmegaConf.merge(cfg, {"env": {"num_envs": num_envs // 2}})
    makers = [
        functools.partial(
            make_env, OmegaConf.merge(half, {"seed": seed}), preference_space, reward_model
        )
        for seed in range(2)
    ]
    return {
        "one process": Collector(
            utils.make_train_env(cfg, preference_space, reward_model),
            mo_ppo.make_policy(start, sigma)[1],
            **settings,
        ),
        "two processes": MultiSyncCollector(
            makers, mo_ppo.make_policy(start, sigma)[1], cat_results=0, **settings
        ),
    }


def mo_ppo_batch(num_envs: int, steps: int, batches: int) -> dict[str, list[float]]:
    """Seconds of every batch but the first, the ways in turns."""
    torch.set_num_threads(2)
    collectors = mo_ppo_collectors(num_envs, steps)
    iterators = {name: iter(collector) for name, collector in collectors.items()}
    seconds: dict[str, list[float]] = {name: [] for name in collectors}
    try:
        for number in tqdm.trange(batches + 1, desc="MO-PPO", unit="batch"):
            for name, iterator in iterators.items():
                begin = time.perf_counter()
                next(iterator)
                if number > 0:  # the first one also makes the environments
                    seconds[name].append(time.perf_counter() - begin)
    finally:
        for collector in collectors.values():
            collector.shutdown()
    return seconds


def row(name: str, measured: list[float], reference: list[float]) -> str:
    """Median, and the median of the ratios within the rounds."""
    ratios = [first / second for first, second in zip(measured, reference, strict=True)]
    return f"| {name} | {statistics.median(measured):.3f} | {statistics.median(ratios):.2f} |"


def main(arguments: list[str] | None = None, *, num_envs: int = 512, steps: int = 64) -> None:
    """Measure; ``--help`` lists the options."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=2, help="of PD-MORL")
    parser.add_argument("--frames", type=int, default=14_400, help="of each training of PD-MORL")
    parser.add_argument("--batches", type=int, default=8, help="of MO-PPO")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2], help="of the updates")
    parser.add_argument("--output", type=Path, default=Path("runs/benchmarks/collecting.md"))
    parser.add_argument("overrides", nargs="*", help="of recipes/pd_morl/config.yaml")
    args = parser.parse_args(arguments)
    if min(args.rounds, args.batches, *args.threads) < 1:
        parser.error("--rounds, --batches and --threads must be at least 1.")
    batch = config(*args.overrides).collector.frames_per_batch
    if args.frames < 3 * batch:
        parser.error(f"--frames must be at least {3 * batch}, three batches, got {args.frames}.")

    ways: dict[str, Callable[[], float]] = {
        f"PD-MORL, {threads} torch thread{'s' * (threads > 1)}{', overlapping' * overlapping}": (
            functools.partial(pd_morl_batch, overlapping, threads, args.frames, args.overrides)
        )
        for threads in args.threads
        for overlapping in (False, True)
    }
    seconds: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(args.rounds):
        for name, way in ways.items():
            # A pool of one for each: compiled code and threads of one training are not the next one's.
            with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
                seconds[name].append(pool.submit(way).result())
    polish = mo_ppo_batch(num_envs, steps, args.batches)
    first, polish_first = next(iter(seconds.values())), polish["one process"]
    lines = [
        "| | seconds a batch | times the first |",
        "| --- | --- | --- |",
        *(row(name, measured, first) for name, measured in seconds.items()),
        *(row(f"MO-PPO, collecting, {k}", v, polish_first) for k, v in polish.items()),
    ]
    text = "\n".join(lines) + "\n\n" + machine()
    print(text)
    args.output.parent.mkdir(parents=True, exist_ok=True)
    args.output.write_text(text + "\n")


if __name__ == "__main__":
    main()
