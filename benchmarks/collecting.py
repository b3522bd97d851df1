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

import functools
import itertools
import multiprocessing
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from unittest import mock

import torch
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDictBase
from torchrl.collectors import Collector, MultiAsyncCollector, MultiSyncCollector
from torchrl.envs import EnvBase, RewardScaling

from recipes.arguments import Parser
from recipes.training import collection, task
from torchrl_morl.deploy import save_reward_model
from torchrl_morl.deploy.features import OBSERVATION_SIZE
from torchrl_morl.modules import RewardModel

from .learner import machine
from .learner_base import ACTION_SIZE
from .output import parse_with_output
from .workload import MO_PPO, PD_MORL, RECIPES, config, run_recipe

POLICY = RECIPES / "policies" / "recipe_seed0"

make_train_env = task.make_train_env


def make_env(cfg: DictConfig, *arguments) -> EnvBase:
    """An environment in a process of its own, which has one core."""
    torch.set_num_threads(1)
    cfg = OmegaConf.merge(cfg, {"env": {"num_threads": 1}})
    return make_train_env(cfg, *arguments)


def make_half(cfg: DictConfig, seed: int, *arguments) -> EnvBase:
    """Half of the environments of MO-PPO, with the scale that the recipe adds to their rewards."""
    half = {"seed": seed, "env": {"num_envs": cfg.env.num_envs // 2}}
    env = make_env(OmegaConf.merge(cfg, half), *arguments)
    return env.append_transform(RewardScaling(0.0, cfg.replay_buffer.reward_scale))


class Clocked:
    """A collector that notes when each batch is asked for, and when it is there."""

    def __init__(
        self, collector: Collector | MultiAsyncCollector | MultiSyncCollector, times: list
    ) -> None:
        self.collector, self.times = collector, times

    def __iter__(self) -> Iterator[TensorDictBase]:
        batches = iter(self.collector)
        while True:
            asked = time.perf_counter()
            batch = next(batches, None)
            if batch is None:
                return
            self.times.append((asked, time.perf_counter()))
            yield batch

    def shutdown(self) -> None:
        self.collector.shutdown()


class NoState:
    """In place of the state of a collector, which collectors of several processes do not have."""

    def __init__(self, *_: object) -> None: ...

    def state_dict(self) -> dict:
        return {}

    def load_state_dict(self, state: dict) -> None: ...


def pd_morl_batch(overlapping: bool, threads: int, frames: int, overrides: list[str]) -> float:
    """Seconds from a batch to the next: the median, to which compiling and evaluations do not matter."""
    times: list[tuple[float, float]] = []

    def collector(env, policy, **settings):
        if not overlapping:
            return Clocked(Collector(env, policy, **settings), times)
        maker = functools.partial(make_env, *makes.call_args.args)
        # The worker gets the latest policy with every batch, as it has it without a process.
        return Clocked(
            MultiAsyncCollector([maker], policy, update_at_each_batch=True, **settings), times
        )

    with (
        tempfile.TemporaryDirectory() as folder,
        mock.patch.object(task, "make_train_env", wraps=make_train_env) as makes,
        mock.patch.object(collection, "Collector", collector),
        mock.patch.object(collection, "CollectorState", NoState),
    ):
        run_recipe(
            PD_MORL,
            f"collector.total_frames={frames}",
            f"collector.init_random_frames={config().collector.frames_per_batch}",
            "evaluation.episodes=2",
            f"compute.torch_threads={threads}",
            *overrides,
            f"hydra.run.dir={folder}/run",
        )
    there = [end for _, end in times]
    return statistics.median(after - before for before, after in itertools.pairwise(there))


def mo_ppo_batch(two_processes: bool, num_envs: int, steps: int, batches: int) -> float:
    """Seconds that a batch is waited for: the median, without the first, which makes the environments."""
    times: list[tuple[float, float]] = []

    def collector(env, policy, **settings):
        if not two_processes:
            return Clocked(Collector(env, policy, **settings), times)
        makers = [
            functools.partial(make_half, makes.call_args.args[0], seed, *makes.call_args.args[1:])
            for seed in range(2)
        ]
        return Clocked(MultiSyncCollector(makers, policy, cat_results=0, **settings), times)

    frames = num_envs * steps
    with (
        tempfile.TemporaryDirectory() as folder,
        mock.patch.object(task, "make_train_env", wraps=make_train_env) as makes,
        mock.patch.object(collection, "Collector", collector),
        mock.patch.object(collection, "CollectorState", NoState),
    ):
        # It has learned nothing: it costs the same.
        size = OBSERVATION_SIZE + ACTION_SIZE
        save_reward_model(Path(folder) / "model", RewardModel(in_features=size), card={})
        run_recipe(
            MO_PPO,
            f"policy={POLICY}",
            f"demonstrations.reward_model={folder}/model",
            f"env.num_envs={num_envs}",
            f"collector.frames_per_batch={frames}",
            f"collector.total_frames={(batches + 1) * frames}",
            # As few updates as there can be: they are not measured.
            f"optim.batch_size={frames}",
            "optim.critic_epochs=1",
            f"optim.critic_batches={batches + 1}",
            "evaluation.episodes=2",
            f"hydra.run.dir={folder}/run",
        )
    return statistics.median(end - asked for asked, end in times[1:])


def row(name: str, measured: list[float], reference: list[float]) -> str:
    """Median, and the median of the ratios within the rounds."""
    ratios = [first / second for first, second in zip(measured, reference, strict=True)]
    return f"| {name} | {statistics.median(measured):.3f} | {statistics.median(ratios):.2f} |"


def main(arguments: list[str] | None = None, *, num_envs: int = 512, steps: int = 64) -> None:
    """Measure; ``--help`` lists the options."""
    parser = Parser(prog="collecting", description=__doc__)
    parser.add_argument("--rounds", type=int, default=2, help="of all trainings")
    parser.add_argument("--frames", type=int, default=14_400, help="of each training of PD-MORL")
    parser.add_argument("--batches", type=int, default=4, help="of each training of MO-PPO")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2], help="of the updates")
    parser.add_argument("overrides", nargs="*", help="of recipes/pd_morl/config.yaml")
    args = parse_with_output(parser, arguments, "collecting.md")
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
    ways |= {
        f"MO-PPO, collecting, {name}": functools.partial(
            mo_ppo_batch, two_processes, num_envs, steps, args.batches
        )
        for two_processes, name in enumerate(("one process", "two processes"))
    }
    seconds: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(args.rounds):
        for name, way in ways.items():
            # A pool of one for each: compiled code and threads of one training are not the next one's.
            with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
                seconds[name].append(pool.submit(way).result())
    lines = ["| | seconds a batch | times the first |", "| --- | --- | --- |"]
    for recipe in ("PD-MORL", "MO-PPO"):
        measured = {name: values for name, values in seconds.items() if name.startswith(recipe)}
        first = next(iter(measured.values()))
        lines += [row(name, values, first) for name, values in measured.items()]
    text = "\n".join(lines) + "\n\n" + machine()
    print(text)
    args.output.parent.mkdir(parents=True, exist_ok=True)
    args.output.write_text(text + "\n")


if __name__ == "__main__":
    main()
