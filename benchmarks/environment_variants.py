"""What the environment benchmark measures: ours, TorchRL's ``MujocoEnv``, and the native calls."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Protocol

import numpy as np
import torch
from torchrl.envs import EnvBase, ParallelEnv, SerialEnv

from envs import NavigationEnv
from envs.mjcf import LIDAR_HEIGHT

from .peers_environment import (
    FRAME_SKIP,
    GOAL_RADIUS,
    LIDAR_GROUPS,
    MAX_EPISODE_STEPS,
    MAX_RANGE,
    NUM_RAYS,
    ROBOT,
    SCENE,
    MujocoNavigationEnv,
    RangefinderNavigationEnv,
)

# Steps after which the bare simulation goes back to its start: without episodes, robots would
# push against boxes for ever.
_BATCH_HORIZON = 50


class Loop(Protocol):
    """Something that steps all of its environments once at a time."""

    def step(self) -> None: ...

    def close(self) -> None: ...


class TorchRLLoop:
    """Random actions and real resets through the TorchRL API: a collector without its policy."""

    def __init__(self, env: EnvBase) -> None:
        self.env = env
        self.data = env.reset()

    def step(self) -> None:
        _, self.data = self.env.step_and_maybe_reset(self.env.rand_action(self.data))

    def close(self) -> None:
        self.env.close()


class BatchLoop:
    """The native calls of a step, physics and rays, with random controls: no TorchRL, no task."""

    def __init__(self, env: NavigationEnv) -> None:
        env.reset()
        self.batch = env.batch
        self.start = self.batch.state.copy()
        self.qpos, self.ctrl = self.batch.bind("qpos"), self.batch.bind("ctrl")
        self.high = np.array([env.robot.max_speed, env.robot.max_turn_rate])
        self.low = np.array([0.0, -env.robot.max_turn_rate])
        angles = 2 * np.pi * np.arange(NUM_RAYS) / NUM_RAYS
        self.rays = np.stack((np.cos(angles), np.sin(angles)), axis=-1)
        self.turn = np.zeros((self.batch.nsim, 2, 3))
        self.origin = np.full((self.batch.nsim, NUM_RAYS, 3), LIDAR_HEIGHT)
        self.direction = np.zeros_like(self.origin)
        self.robot = env.model.body("robot").id
        self.rng = np.random.default_rng(0)
        self.steps = 0

    def step(self) -> None:
        if self.steps % _BATCH_HORIZON == 0:
            self.batch.state[...] = self.start
        self.steps += 1
        self.ctrl[:, :2] = self.rng.uniform(self.low, self.high, (self.batch.nsim, 2))
        self.batch.step(nstep=FRAME_SKIP)
        cos, sin = np.cos(self.qpos[:, 2]), np.sin(self.qpos[:, 2])
        self.turn[:, 0, 0] = self.turn[:, 1, 1] = cos
        self.turn[:, 0, 1], self.turn[:, 1, 0] = sin, -sin
        np.matmul(self.rays, self.turn, out=self.direction)
        self.origin[..., :2] = self.qpos[:, None, :2]
        self.batch.ray(self.origin, self.direction, geomgroup=LIDAR_GROUPS, bodyexclude=self.robot)

    def close(self) -> None:
        pass


def first_elapsed(num_envs: int) -> list[int]:
    """First episodes of evenly spread lengths: resets come one by one, as in a long training."""
    return [index * MAX_EPISODE_STEPS // num_envs for index in range(num_envs)]


def navigation_env(num_envs: int, num_threads: int, *, snapshots: bool = False) -> NavigationEnv:
    return NavigationEnv(
        scene=SCENE,
        robot=ROBOT,
        goal_radius=GOAL_RADIUS,
        num_rays=NUM_RAYS,
        max_range=MAX_RANGE,
        max_episode_steps=MAX_EPISODE_STEPS,
        num_envs=num_envs,
        num_threads=num_threads,
        snapshots=snapshots,
        seed=0,
    )


def navigation_loop(num_envs: int, num_threads: int, *, snapshots: bool) -> Loop:
    env = navigation_env(num_envs, num_threads, snapshots=snapshots)
    loop = TorchRLLoop(env)
    env._elapsed[:, 0] = torch.tensor(first_elapsed(num_envs))
    return loop


def mujoco_envs(
    num_envs: int, make: Callable[..., EnvBase] = MujocoNavigationEnv
) -> list[Callable[[], EnvBase]]:
    return [
        functools.partial(make, seed=seed, elapsed=elapsed)
        for seed, elapsed in enumerate(first_elapsed(num_envs))
    ]


def _mujoco_loop(num_envs: int, num_threads: int) -> Loop:
    (make_env,) = mujoco_envs(num_envs)
    return TorchRLLoop(make_env())


def _serial_loop(make: Callable[..., EnvBase], num_envs: int, num_threads: int) -> Loop:
    return TorchRLLoop(SerialEnv(num_envs, mujoco_envs(num_envs, make)))


def _parallel_loop(make: Callable[..., EnvBase], num_envs: int, num_threads: int) -> Loop:
    envs = mujoco_envs(num_envs, make)
    return TorchRLLoop(ParallelEnv(num_envs, envs, mp_start_method="fork"))


def _batch_loop(num_envs: int, num_threads: int) -> Loop:
    return BatchLoop(navigation_env(num_envs, num_threads))


OURS = "NavigationEnv"

_COMPETITORS: dict[str, Callable[..., EnvBase]] = {
    "one mj_multiRay": MujocoNavigationEnv,
    "rangefinders": RangefinderNavigationEnv,
    "rangefinders once": functools.partial(RangefinderNavigationEnv, once=True),
}
"""Ways to a lidar in ``MujocoEnv``."""

SERIAL = {f"MujocoEnv, {name}, SerialEnv": make for name, make in _COMPETITORS.items()}
PARALLEL = {f"MujocoEnv, {name}, ParallelEnv": make for name, make in _COMPETITORS.items()}

VARIANTS: dict[str, Callable[[int, int], Loop]] = {
    OURS: functools.partial(navigation_loop, snapshots=False),
    "NavigationEnv, snapshots": functools.partial(navigation_loop, snapshots=True),
    "MujocoEnv, one mj_multiRay": _mujoco_loop,
    **{name: functools.partial(_serial_loop, make) for name, make in SERIAL.items()},
    **{name: functools.partial(_parallel_loop, make) for name, make in PARALLEL.items()},
    "Batch without TorchRL": _batch_loop,
}
"""What is measured: name, and ``make(num_envs, num_threads)``."""
