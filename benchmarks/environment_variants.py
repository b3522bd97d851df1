"""What the environment benchmark measures: ours, TorchRL's ``MujocoEnv``, and the native calls."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable
from typing import Protocol

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
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

# Drawn before the measurement: random numbers are the policy's work.
_NUM_ACTIONS = 256


class Loop(Protocol):
    """Something that steps all of its environments once at a time."""

    def step(self) -> None: ...

    def close(self) -> None: ...


class TorchRLLoop:
    """Random actions and real resets through the TorchRL API: a collector without its policy."""

    def __init__(self, env: EnvBase) -> None:
        self.env = env
        self.data = env.reset()
        self.actions = itertools.cycle(
            [env.rand_action()["action"].clone() for _ in range(_NUM_ACTIONS)]
        )

    def step(self) -> None:
        self.data.set("action", next(self.actions))
        _, self.data = self.env.step_and_maybe_reset(self.data)

    def close(self) -> None:
        self.env.close()


class EmptyEnv(EnvBase):
    """The specs of a :class:`NavigationEnv` and nothing behind them: what TorchRL itself costs.

    It observes the same at every step and earns nothing. Episodes are truncated, and reset, as in
    the other environments.

    Args:
        env: whose specs to take.
    """

    batch_locked = True

    def __init__(self, env: NavigationEnv) -> None:
        super().__init__(batch_size=env.batch_size)
        for name in ("observation_spec", "action_spec", "reward_spec", "full_done_spec"):
            setattr(self, name, getattr(env, name).clone())
        self.observed = dict(env.reset().select(*self.observation_spec.keys()).items())
        self.reward = self.reward_spec.zero()
        self.running = torch.zeros(env.num_envs, 1, dtype=torch.bool)
        self.elapsed = np.array(first_elapsed(env.num_envs))[:, None]

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs) -> TensorDictBase:
        if tensordict is not None:
            self.elapsed[tensordict["_reset"].numpy()] = 0
        return TensorDict(self.observed, batch_size=self.batch_size)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.elapsed += 1
        truncated = self.running
        if self.elapsed.max() >= MAX_EPISODE_STEPS:
            truncated = torch.from_numpy(self.elapsed >= MAX_EPISODE_STEPS)
        ends = {"terminated": self.running, "truncated": truncated, "done": truncated}
        # Without a look at the shapes, as the environments that TorchRL comes with.
        return TensorDict._new_unsafe(
            {**self.observed, "reward": self.reward, **ends}, batch_size=self.batch_size
        )

    def _set_seed(self, seed: int | None) -> None:
        pass


class BatchLoop:
    """Physics and lidar of a step, with random controls: no TorchRL, no task, no new tensors."""

    def __init__(self, env: NavigationEnv) -> None:
        env.reset()
        self.batch, self.lidar, self.task = env.batch, env._lidar, env._task
        self.start = self.batch.state.copy()
        self.qpos, self.ctrl = self.batch.bind("qpos"), self.batch.bind("ctrl")
        self.high = np.array([env.robot.max_speed, env.robot.max_turn_rate])
        self.low = np.array([0.0, -env.robot.max_turn_rate])
        self.rng = np.random.default_rng(0)
        self.steps = 0

    def step(self) -> None:
        if self.steps % _BATCH_HORIZON == 0:
            self.batch.state[...] = self.start
        self.steps += 1
        self.ctrl[:, :2] = self.rng.uniform(self.low, self.high, (self.batch.nsim, 2))
        self.batch.step(nstep=FRAME_SKIP)
        self.scan()

    def scan(self) -> np.ndarray:
        """Ranges ``[N, rays]``, metres."""
        position, cos, sin = self.qpos[:, :2], np.cos(self.qpos[:, 2]), np.sin(self.qpos[:, 2])
        self.task.locate(position)
        seen = self.task.ahead_and_left(cos, sin)
        return self.lidar.cast(seen, cos, sin, self.task.boxes, self.task.radius)

    def close(self) -> None:
        pass


class BatchRayLoop(BatchLoop):
    """The same with MuJoCo's own rays, every one of them."""

    def __init__(self, env: NavigationEnv) -> None:
        super().__init__(env)
        self.body = env.model.body("robot").id
        self.angles = 2 * np.pi * np.arange(NUM_RAYS) / NUM_RAYS
        # Filled, entry by entry: Batch.ray would copy the three of every ray by themselves.
        self.origin = np.full((self.batch.nsim, NUM_RAYS, 3), LIDAR_HEIGHT)
        self.rays = np.zeros((self.batch.nsim, NUM_RAYS, 3))

    def scan(self) -> np.ndarray:
        """Ranges ``[N, rays]``, metres; -1 of rays that meet nothing."""
        angle = self.qpos[:, 2:3] + self.angles
        np.cos(angle, out=self.rays[..., 0])
        np.sin(angle, out=self.rays[..., 1])
        self.origin[..., :2] = self.qpos[:, None, :2]
        return self.batch.ray(
            self.origin, self.rays, geomgroup=LIDAR_GROUPS, bodyexclude=self.body
        )[0]


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


def _empty_loop(num_envs: int, num_threads: int) -> Loop:
    return TorchRLLoop(EmptyEnv(navigation_env(num_envs, num_threads)))


def _batch_loop(num_envs: int, num_threads: int) -> Loop:
    return BatchLoop(navigation_env(num_envs, num_threads))


def _batch_ray_loop(num_envs: int, num_threads: int) -> Loop:
    return BatchRayLoop(navigation_env(num_envs, num_threads))


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
    "TorchRL without simulation": _empty_loop,
    "Batch without TorchRL": _batch_loop,
    "Batch without TorchRL, Batch.ray": _batch_ray_loop,
}
"""What is measured: name, and ``make(num_envs, num_threads)``."""
