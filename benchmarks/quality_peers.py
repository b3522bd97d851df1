"""CAPQL and GPI-LS of MORL-Baselines on the navigation task, evaluated as the recipe's policies are.

They drive ``mo_gymnasium.make("torchrl_morl/Navigation-v0")``, one simulation, with actions
rescaled to [-1, 1] and rewards scaled as in the recipe. Their weights are points of the simplex over all
objectives: a preference of ours, with the core objective at one, is one of them up to a factor.
"""

from __future__ import annotations

import contextlib
import random
from collections.abc import Callable
from typing import Any

import gymnasium
import mo_gymnasium
import numpy as np
import torch
from tensordict.nn import TensorDictModule
from torch import Tensor

import envs.gym
from recipes.pd_morl import utils
from torchrl_morl.preferences import PreferenceSpace

from .peers_morl_baselines import CELLS, algorithm

BATCH_SIZE = 256


class Finished(Exception):
    """Ends a training from within its environment: peers have no other way to stop at a time."""


class Watched(gymnasium.Wrapper):
    """Scales the reward and reports every step.

    Args:
        env: to wrap.
        scale: of the reward vector.
        after_step: called with the number of steps so far.
    """

    def __init__(self, env: gymnasium.Env, scale: float, after_step: Callable[[int], None]) -> None:
        super().__init__(env)
        self.scale, self.after_step, self.steps = scale, after_step, 0

    def step(self, action: np.ndarray) -> tuple[Any, ...]:
        observation, reward, *rest = self.env.step(action)
        self.steps += 1
        self.after_step(self.steps)
        return observation, self.scale * reward, *rest


def make_env(
    seed: int, scale: float, after_step: Callable[[int], None] = lambda steps: None
) -> gymnasium.Env:
    spec = next(name for name in gymnasium.registry if name.endswith("/Navigation-v0"))
    assert envs.gym.__name__  # which registers it
    env = gymnasium.wrappers.RescaleAction(mo_gymnasium.make(spec), -1.0, 1.0)
    env.reset(seed=seed)
    env.action_space.seed(seed)
    return Watched(env, scale, after_step)


def simplex_weights(space: PreferenceSpace, preference: Tensor) -> Tensor:
    """The peers' weights for preferences of ours."""
    weights = space.weights(preference)
    return weights / weights.sum(-1, keepdim=True)


class _OurWeights:
    """In place of CAPQL's cone around equal weights: the weights that the evaluation asks for."""

    def __init__(self, *_: Any) -> None:
        self.space = utils.make_preference_space(with_demonstrations=False)

    def sample(self, number: int) -> Tensor:
        return simplex_weights(self.space, self.space.sample(number))


class Peer:
    """An agent of MORL-Baselines and its training.

    Args:
        name: ``"capql"``, ``"capql-our-weights"`` or ``"gpi-ls"``.
        env: to train in.
        seed: of everything.
        gamma: discount; their default is 0.99.
    """

    NAMES = ("capql", "capql-our-weights", "gpi-ls")

    def __init__(self, name: str, env: gymnasium.Env, *, seed: int, gamma: float) -> None:
        random.seed(seed)
        np.random.seed(seed)
        torch.manual_seed(seed)
        self.name, self.env = name, env
        self.space = utils.make_preference_space(with_demonstrations=False)
        options = {
            "net_arch": CELLS,
            "batch_size": BATCH_SIZE,
            "gradient_updates": 1,
            "gamma": gamma,
            "log": False,
            "seed": seed,
            "device": "cpu",
        }
        if name == "gpi-ls":
            module = algorithm("gpi_pd.gpi_pd_continuous_action")
            self.agent = module.GPILSContinuousAction(env, **options)
            self._act = self.agent.policy
        else:
            module = algorithm("capql.capql")
            if name == "capql-our-weights":
                module.WeightSamplerAngle = _OurWeights
            self.agent = module.CAPQL(env, **options)
            self._act = self.agent.policy.get_action

    @property
    def actor(self) -> TensorDictModule:
        """The deterministic policy, as the recipe's evaluation calls it."""

        def act(observation: Tensor, preference: Tensor) -> Tensor:
            return self._act(observation, simplex_weights(self.space, preference))

        return TensorDictModule(act, in_keys=["observation", "preference"], out_keys=["action"])

    def train(self, total_steps: int, eval_env: gymnasium.Env) -> None:
        """Until the environment raises :class:`Finished`, or for so many steps."""
        with contextlib.suppress(Finished):
            self.agent.train(
                total_timesteps=total_steps,
                eval_env=eval_env,
                ref_point=np.full(self.space.num_objectives, -100.0),
            )
