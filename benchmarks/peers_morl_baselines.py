"""CAPQL and GPI-LS of MORL-Baselines, an optional dependency of the benchmarks alone.

``benchmarks/README.md`` says how to install it.
"""

from __future__ import annotations

import importlib
from types import ModuleType

import gymnasium
import numpy as np
import torch
from tensordict import TensorDict

from .learner_base import ACTION_SIZE, Learner, Stage

CELLS = [256, 256, 256, 256]


def algorithm(name: str) -> ModuleType:
    """A module of MORL-Baselines, ``"capql.capql"`` for example."""
    try:
        return importlib.import_module(f"morl_baselines.multi_policy.{name}")
    except ImportError as error:
        raise ImportError(
            f"{error}. benchmarks/README.md says how to install MORL-Baselines."
        ) from error


class _Sizes(gymnasium.Env):
    """Nothing but the spaces that an agent of MORL-Baselines asks for."""

    def __init__(self, observation_size: int, num_objectives: int) -> None:
        def box(size: int, bound: float) -> gymnasium.spaces.Box:
            return gymnasium.spaces.Box(-bound, bound, (size,), np.float32)

        self.observation_space = box(observation_size, np.inf)
        self.action_space = box(ACTION_SIZE, 1.0)
        self.reward_space = box(num_objectives, np.inf)
        self.reward_dim = num_objectives


def _env(data: TensorDict) -> _Sizes:
    return _Sizes(data["observation"].shape[-1], data["next", "reward"].shape[-1])


def _columns(data: TensorDict) -> list[np.ndarray]:
    keys = ("observation", "action", ("next", "reward"), ("next", "observation"))
    return [*(data[key].numpy() for key in keys), data["next", "terminated"].float().numpy()]


class _Peer(Learner):
    def __init__(self, update) -> None:
        super().__init__()
        self._update = update

    def critic_stages(self) -> list[Stage]:
        return [("everything", self._update)]


def capql(data: TensorDict) -> Learner:
    """CAPQL: soft actor-critic, the actor at every update."""
    agent = algorithm("capql.capql").CAPQL(
        _env(data), net_arch=CELLS, batch_size=256, log=False, device="cpu"
    )
    weights = np.random.default_rng(0).dirichlet(np.ones(agent.reward_dim), len(data))
    for state, action, reward, following, done, w in zip(
        *_columns(data), weights.astype(np.float32), strict=True
    ):
        agent.replay_buffer.push(state, action, w, reward, following, done[0])
    return _Peer(agent.update)


def gpi_ls(data: TensorDict, batch_size: int) -> Learner:
    """GPI-LS for continuous actions: TD3, the actor at every second update.

    Once it knows more than one solution it trains every sampled transition under two preferences,
    the current one and one it knows: twice ``batch_size`` rows, as from the second iteration on.
    """
    agent = algorithm("gpi_pd.gpi_pd_continuous_action").GPILSContinuousAction(
        _env(data),
        net_arch=CELLS,
        batch_size=batch_size,
        gradient_updates=1,
        buffer_size=len(data),
        log=False,
        device="cpu",
    )
    for columns in zip(*_columns(data), strict=True):
        agent.replay_buffer.add(*columns)
    agent.set_weight_support(list(np.eye(agent.reward_dim)))
    weight = torch.full((agent.reward_dim,), 1 / agent.reward_dim)
    return _Peer(lambda: agent.update(weight))
