"""Any environment with a vector reward, of MO-Gymnasium, of Gymnasium, or your own, as a policy sees it."""

from __future__ import annotations

import contextlib
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from copy import deepcopy
from typing import Any

import gymnasium
import mo_gymnasium
import mujoco
import numpy as np
from gymnasium.spaces import Box, Discrete
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.vector.utils import concatenate, iterate
from gymnasium.wrappers import DtypeObservation, FlattenObservation, RescaleAction
from tensordict import TensorDictBase
from torchrl.envs import MOGymWrapper

__all__ = ["VectorMOGymEnv", "make_mo_gym_env"]


def make_mo_gym_env(
    name: str,
    *,
    num_envs: int = 1,
    max_episode_steps: int | None = None,
    **kwargs: Any,
) -> VectorMOGymEnv:
    """Make environments of one kind, stepped one after the other in this process.

    Observations of every kind are flat and single precision, continuous actions are in [-1, 1].

    Args:
        name: id of Gymnasium or MO-Gymnasium; ``module:Name-v0`` imports the module that registers it.

    Keyword Args:
        num_envs: how many.
        max_episode_steps: steps before an episode is truncated; ``None`` is the environment's own.
        **kwargs: of the environment.

    Returns:
        An environment of batch size ``[num_envs]`` with ``observation`` ``[num_envs, F]``, ``reward``
        ``[num_envs, K]``, and an ``action`` ``[num_envs, A]``, or a whole number ``[num_envs]`` where it is
        discrete.

    Raises:
        ValueError: in one line, for a name that is not registered, an environment with a scalar
            reward, without a time limit, or with other actions.

    Examples:
        >>> env = make_mo_gym_env("deep-sea-treasure-v0", num_envs=2)
        >>> env.rollout(1)["next", "reward"].shape
        torch.Size([2, 1, 2])
        >>> make_mo_gym_env("CartPole-v1")
        Traceback (most recent call last):
        ...
        ValueError: CartPole-v1 has a scalar reward: its env.unwrapped.reward_space must be a Box of \
shape (K,), one entry per objective.
    """

    def make() -> gymnasium.Env:
        limit = {} if max_episode_steps is None else {"max_episode_steps": max_episode_steps}
        try:
            with warnings.catch_warnings():
                # What Gymnasium finds in environments is for those who write them, and a name may be old.
                warnings.simplefilter("ignore", UserWarning)
                warnings.simplefilter("ignore", DeprecationWarning)
                env = mo_gymnasium.make(name, **limit, **kwargs)
        except (gymnasium.error.Error, ImportError, TypeError) as error:
            raise ValueError(f"{name} cannot be made: {' '.join(str(error).split())}") from error
        return _as_a_policy_sees_it(name, env)

    with _each_warning_once():
        envs = _VectorRewards([make] * num_envs)
    return VectorMOGymEnv(envs, categorical_action_encoding=True)


class VectorMOGymEnv(MOGymWrapper):
    """TorchRL's :class:`~torchrl.envs.MOGymWrapper` of vector environments that reset when they are told."""

    @property
    def max_episode_steps(self) -> int:
        """Steps before an episode is truncated."""
        return self._env.envs[0].spec.max_episode_steps

    @property
    def period(self) -> float:
        """Seconds of a step, where the environment has a ``dt``; else 1."""
        return float(getattr(self._env.envs[0].unwrapped, "dt", 1.0))

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        # TorchRL 0.14 looks for a mask in whatever it is given, such as a preference alone.
        if tensordict is not None and "_reset" not in tensordict.keys():
            tensordict = None
        return super()._reset(tensordict, **kwargs)


class _VectorRewards(SyncVectorEnv):
    """Gymnasium's, with a reward of several entries; one that is done stands still until it is reset.

    MO-Gymnasium has such a class, which resets by itself one step late; TorchRL refuses that.
    """

    def __init__(self, makers: Sequence[Callable[[], gymnasium.Env]]) -> None:
        super().__init__(makers, autoreset_mode=AutoresetMode.DISABLED)
        # With its batch, since TorchRL takes K entries for K environments where the numbers agree; without
        # bounds, since some transforms of rewards take no others.
        shape = (self.num_envs, *self.envs[0].unwrapped.reward_space.shape)
        self.reward_space = Box(-np.inf, np.inf, shape, np.float32)
        self._rewards = np.zeros(shape, dtype=np.float32)

    def step(self, actions: Any) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict]:
        done = self._terminations | self._truncations
        self._rewards[done] = 0.0
        for index, action in _going_on(iterate(self.action_space, actions), done):
            observed, reward, terminated, truncated, _ = self.envs[index].step(action)
            self._env_obs[index], self._rewards[index] = observed, reward
            self._terminations[index], self._truncations[index] = terminated, truncated
        self._observations = concatenate(
            self.single_observation_space, self._env_obs, self._observations
        )
        return (
            deepcopy(self._observations),
            self._rewards.copy(),
            self._terminations.copy(),
            self._truncations.copy(),
            {},
        )


@contextlib.contextmanager
def _each_warning_once() -> Iterator[None]:
    """MuJoCo warns about a model whenever it reads it, once for each of many environments."""
    known: set[str] = set()

    def warn(message: str) -> None:
        if message not in known:
            known.add(message)
            print(f"MuJoCo: {message}", file=sys.stderr)

    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(warn)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)


def _going_on(actions: Iterator[Any], done: np.ndarray) -> Iterator[tuple[int, Any]]:
    return ((index, action) for index, action in enumerate(actions) if not done[index])


def _as_a_policy_sees_it(name: str, env: gymnasium.Env) -> gymnasium.Env:
    space = getattr(env.unwrapped, "reward_space", None)
    if not isinstance(space, Box) or len(space.shape) != 1 or space.shape[0] < 2:
        found = "a scalar reward" if space is None else f"the reward_space {space}"
        raise ValueError(
            f"{name} has {found}: its env.unwrapped.reward_space must be a Box of shape (K,), "
            "one entry per objective."
        )
    if env.spec is None or env.spec.max_episode_steps is None:
        raise ValueError(f"{name} has no time limit: give max_episode_steps.")
    if not env.observation_space.is_np_flattenable:
        raise ValueError(f"{name}: its observations, {env.observation_space}, cannot be flattened.")
    actions = env.action_space
    if isinstance(actions, Box):
        if len(actions.shape) != 1 or not actions.is_bounded():
            raise ValueError(
                f"{name}: its actions must be a row of bounded numbers, got {actions}."
            )
        if not ((actions.low == -1).all() and (actions.high == 1).all()):
            env = RescaleAction(env, np.float32(-1.0), np.float32(1.0))
    elif not isinstance(actions, Discrete):
        raise ValueError(f"{name}: its actions must be a Box or Discrete, got {actions}.")
    return DtypeObservation(FlattenObservation(env), np.float32)
