"""What the growth benchmark measures: one piece of the pipeline at one size, in one process.

Everything has the sizes of the recipe but the one that grows. ``CASES`` names the pieces.
"""

from __future__ import annotations

import logging
import resource
import statistics
import sys
import time
from collections.abc import Callable
from typing import NamedTuple

import torch
import torchrl

from envs.demonstrations import CircleDemonstrator
from recipes.evaluation.sweep import sweep
from recipes.training.agent import make_actor
from recipes.training.loss import make_loss
from recipes.training.replay import make_replay_buffer
from recipes.training.task import make_preference_space, make_train_env
from torchrl_morl.preferences import PreferenceSpace

from .workload import config, make_task, transitions

CLOCKS: dict[str, Callable[[], float]] = {"wall": time.perf_counter, "cpu": time.process_time}

_FEW_ROWS = 10_000
_ACTIONS = 8


class Options(NamedTuple):
    """Of all cases."""

    clock: str = "wall"
    seconds: float = 1.0
    """Of the repetitions of a short measurement."""
    scenes: int = 10
    """Of the sweep."""
    steps: int = 50
    """Of the sweep's longest episode."""


class Cost(NamedTuple):
    """Of one size."""

    seconds: float
    bytes: float
    """At the peak, beyond what the process had when the case began."""


def peak() -> int:
    """Most memory that this process ever had, bytes."""
    unit = 1 if sys.platform == "darwin" else 1024
    return unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def seconds_of(run: Callable[[], object], options: Options) -> float:
    """Of one call: median over calls, the first one left out."""
    clock = CLOCKS[options.clock]
    run()
    spent: list[float] = []
    while len(spent) < 3 or sum(spent) < options.seconds:
        start = clock()
        run()
        spent.append(clock() - start)
    return statistics.median(spent)


def environments(size: int, options: Options) -> float:
    """A step of all environments of a training: physics, scan, observation, preference, resets."""
    segments = min(size, config().preference.num_segments)
    cfg = config(f"env.num_envs={size}", f"preference.num_segments={segments}")
    env = make_train_env(cfg, make_preference_space(with_demonstrations=False), None)
    data = env.reset()
    # Drawn before the measurement: that is the work of a policy.
    actions = [env.action_spec.rand() for _ in range(_ACTIONS)]
    turn = 0

    def step() -> None:
        nonlocal data, turn
        turn += 1
        data["action"] = actions[turn % _ACTIONS]
        _, data = env.step_and_maybe_reset(data)

    seconds = seconds_of(step, options)
    env.close()
    return seconds


def objectives(size: int, options: Options) -> float:
    """Critics' loss, actor's loss and a relabelled batch."""
    cfg = config("compute.compile=false")
    names = ("core", *(f"objective_{i}" for i in range(1, size)))
    preference_space = PreferenceSpace(names, static={"core": 1.0})
    task = make_task(cfg, preference_space)
    loss = make_loss(cfg, task, make_actor(cfg, task))
    task.env.close()
    loss.interpolator.refit(-torch.rand(preference_space.num_tunable, preference_space.num_tunable))
    data = transitions(_FEW_ROWS)
    data["preference"] = preference_space.sample(_FEW_ROWS)
    data["next", "preference"] = data["preference"].clone()
    data["next", "reward"] = 10 * torch.randn(_FEW_ROWS, size)
    replay_buffer = make_replay_buffer(cfg, task)
    replay_buffer.extend(data)

    def losses() -> None:
        batch = replay_buffer.sample(cfg.replay_buffer.batch_size)
        loss.value_loss(batch)
        loss.actor_loss(batch)

    return seconds_of(losses, options)


def replay(size: int, options: Options) -> float:
    """Relabelled batches for the updates between two batches of the collector, all at once."""
    cfg = config(f"replay_buffer.size={size}")
    task = make_task(cfg)
    task.env.close()
    replay_buffer = make_replay_buffer(cfg, task)
    # By and by, as a collector does it: the memory is that of the storage.
    data = transitions(min(size, _FEW_ROWS))
    for _ in range(-(-size // len(data))):
        replay_buffer.extend(data)
    return seconds_of(replay_buffer.sample, options)


def preferences(size: int, options: Options) -> float:
    """A sweep, distances to demonstrations included; the policy is an untrained one."""
    clock = CLOCKS[options.clock]
    cfg = config()
    task = make_task(cfg)
    preference_space = task.preference_space
    actor = make_actor(cfg, task)
    task.env.close()
    start = clock()
    result = sweep(
        actor,
        preference_space,
        preference_space.sample(size),
        episodes=options.scenes,
        seed=0,
        max_episode_steps=options.steps,
        demonstrator=CircleDemonstrator(),
        num_threads=1,
    )
    assert result.metrics.shape == (size, options.scenes)
    return clock() - start


CASES: dict[str, Callable[[int, Options], float]] = {
    "environments": environments,
    "objectives": objectives,
    "replay": replay,
    "preferences": preferences,
}


def measure(case: str, size: int, options: Options) -> Cost:
    """In a process of its own, since a peak never falls."""
    torchrl.logger.setLevel(logging.WARNING)
    torch.set_num_threads(1)
    torch.manual_seed(0)
    before = peak()
    seconds = CASES[case](size, options)
    return Cost(seconds, peak() - before)
