"""CAPQL and GPI-LS of MORL-Baselines on the navigation task, evaluated as the recipe's policies are.

They drive ``mo_gymnasium.make("torchrl_morl/Navigation-v0")``, one simulation, with actions
rescaled to [-1, 1] and rewards scaled as in the recipe. Their weights are points of the simplex over all
objectives: a preference of ours, with the core objective at one, is one of them up to a factor.
"""

from __future__ import annotations

import contextlib
import inspect
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import mo_gymnasium
import numpy as np
import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import Bounded

import envs.gym
from envs import NavigationEnv
from recipes.training.task import make_preference_space
from torchrl_morl.deploy import save_policy
from torchrl_morl.modules import RewardModel, make_actor
from torchrl_morl.preferences import PreferenceSpace

from .peers_morl_baselines import CELLS, algorithm

BATCH_SIZE = 256

_DEFAULTS = inspect.signature(NavigationEnv.__init__).parameters
ENV = {
    "num_envs": 1,
    **{
        name: _DEFAULTS[name].default
        for name in ("scene", "robot", "goal_radius", "max_episode_steps")
    },
}
"""Of Navigation-v0, for the cards of policies."""


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
    seed: int,
    scale: float,
    after_step: Callable[[int], None] = lambda steps: None,
    reward_model: RewardModel | None = None,
) -> gymnasium.Env:
    spec = next(name for name in gymnasium.registry if name.endswith("/Navigation-v0"))
    assert envs.gym.__name__  # which registers it
    env = mo_gymnasium.make(spec, reward_model=reward_model)
    env = gymnasium.wrappers.RescaleAction(env, -1.0, 1.0)
    env.reset(seed=seed)
    env.action_space.seed(seed)
    return Watched(env, scale, after_step)


def simplex_weights(preference_space: PreferenceSpace, preference: Tensor) -> Tensor:
    """The peers' weights for preferences of ours."""
    weights = preference_space.weights(preference)
    return weights / weights.sum(-1, keepdim=True)


class _OurWeights:
    """In place of CAPQL's cone around equal weights: the weights that the evaluation asks for."""

    def __init__(self, num_objectives: int, *_: Any) -> None:
        with_demonstrations = num_objectives > len(NavigationEnv.objectives)
        self.preference_space = make_preference_space(with_demonstrations=with_demonstrations)

    def sample(self, number: int) -> Tensor:
        return simplex_weights(self.preference_space, self.preference_space.sample(number))


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
        with_demonstrations = "demo" in env.unwrapped.objectives
        self.preference_space = make_preference_space(with_demonstrations=with_demonstrations)
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
            return self._act(observation, simplex_weights(self.preference_space, preference))

        return TensorDictModule(act, in_keys=["observation", "preference"], out_keys=["action"])

    def save(self, folder: Path, card: dict[str, Any]) -> None:
        """As a policy of ours, which ``recipes.results.evaluate`` takes.

        Raises:
            ValueError: for GPI-LS, whose actor has another form.
        """
        if self.name == "gpi-ls":
            raise ValueError("Only the actors of CAPQL can be saved, not those of gpi-ls.")
        observation_size = self.env.observation_space.shape[0]
        actor = make_actor(
            Bounded(-1.0, 1.0, (2,)),
            in_features=observation_size + self.preference_space.num_tunable,
            num_cells=CELLS,
        )
        layers = [layer for layer in actor.modules() if isinstance(layer, nn.Linear)]
        policy = self.agent.policy
        theirs = [layer for layer in policy.latent_pi if isinstance(layer, nn.Linear)]
        with torch.no_grad():
            for ours, layer in zip(layers[1:], [*theirs[1:], policy.mean], strict=True):
                ours.load_state_dict(layer.state_dict())
            # Their weights are an affine function of our preference, for the first layer to take over.
            corners = simplex_weights(
                self.preference_space, torch.eye(self.preference_space.num_tunable)
            )
            seen, weighed = theirs[0].weight.split((observation_size, corners.shape[-1]), dim=1)
            layers[0].weight.copy_(torch.cat((seen, weighed @ corners.T), dim=1))
            layers[0].bias.copy_(theirs[0].bias)
        save_policy(
            folder,
            actor,
            preference_space=self.preference_space,
            card=card,
        )

    def train(self, total_steps: int, eval_env: gymnasium.Env) -> None:
        """Until the environment raises :class:`Finished`, or for so many steps."""
        with contextlib.suppress(Finished):
            self.agent.train(
                total_timesteps=total_steps,
                eval_env=eval_env,
                ref_point=np.full(self.preference_space.num_objectives, -100.0),
            )
