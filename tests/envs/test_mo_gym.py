"""Environments with a vector reward: shapes, starts, ends, and what is refused."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Dict, Discrete, MultiDiscrete
from tensordict.nn import TensorDictModule
from torchrl.envs import Compose, TransformedEnv, check_env_specs

from envs.mo_gym import make_mo_gym_env
from torchrl_morl import PreferenceSpace
from torchrl_morl.evaluation import rollout_preferences
from torchrl_morl.transforms import PreferenceSampler


class Counting(gymnasium.Env):
    """Ends after as many steps as its seeded start says; the reward is (action, step)."""

    reward_space = Box(-np.inf, np.inf, (2,))

    def __init__(self, actions=None, observations=None) -> None:
        self.action_space = (
            Box(np.float32([-2.0]), np.float32([4.0])) if actions is None else actions
        )
        self.observation_space = (
            Box(0, 100, (2,), np.int64) if observations is None else observations
        )

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps, self.last = 0, int(self.np_random.integers(2, 9))
        return self._observe(), {}

    def _observe(self):
        if isinstance(self.observation_space, Dict):
            return {"kind": 2, "value": np.array([0.5])}
        return np.array([self.steps, self.last])

    def step(self, action):
        self.steps += 1
        reward = np.array([float(np.asarray(action).reshape(-1)[0]), self.steps], np.float64)
        return self._observe(), reward, self.steps >= self.last, False, {}


class Scalar(Counting):
    reward_space = None


@pytest.fixture(autouse=True, scope="module")
def registered():
    names = {
        "Counting-v0": (Counting, 20),
        "Endless-v0": (Counting, None),
        "Scalar-v0": (Scalar, 20),
    }
    for name, (kind, limit) in names.items():
        gymnasium.register(name, kind, max_episode_steps=limit)
    yield
    for name in names:
        del gymnasium.registry[name]


@pytest.mark.parametrize("num_envs", [1, 2, 3])  # two: as many as objectives
def test_specs_are_those_of_the_data(num_envs):
    env = make_mo_gym_env("Counting-v0", num_envs=num_envs)
    check_env_specs(env)
    assert env.batch_size == (num_envs,)
    assert env.reward_spec.shape == (num_envs, 2)
    assert env.observation_spec["observation"].shape == (num_envs, 2)
    data = env.rollout(3)
    assert data["observation"].dtype == data["next", "reward"].dtype == torch.float32
    assert env.max_episode_steps == 20


def test_actions_are_scaled_to_the_environment():
    env = make_mo_gym_env("Counting-v0", num_envs=3)
    data = env.reset().set("action", torch.tensor([[-1.0], [0.0], [1.0]]))
    reward = env.step(data)["next", "reward"]
    torch.testing.assert_close(reward, torch.tensor([[-2.0, 1.0], [1.0, 1.0], [4.0, 1.0]]))


def test_one_that_is_done_stands_still_until_it_is_reset():
    env = make_mo_gym_env("Counting-v0", num_envs=2)
    env.set_seed(0)
    data = env.reset()
    lasts = data["observation"][:, 1].tolist()
    assert lasts[0] != lasts[1]
    first = min(range(2), key=lasts.__getitem__)
    for _ in range(int(lasts[first])):
        data = env.step(data.set("action", torch.zeros(2, 1)))["next"]
    assert data["done"][:, 0].tolist() == [index == first for index in range(2)]
    after = env.step(data.clone().set("action", torch.zeros(2, 1)))["next"]
    assert after["done"][first] and (after["reward"][first] == 0).all()
    assert after["observation"][first].equal(data["observation"][first])
    assert after["observation"][1 - first, 0] == data["observation"][1 - first, 0] + 1
    # A reset by mask begins an episode in that one alone.
    mask = (torch.arange(2) == first).unsqueeze(-1)
    again = env.reset(after.clone().set("_reset", mask))
    assert again["observation"][first, 0] == 0 and not again["done"][first]
    assert again["observation"][1 - first].equal(after["observation"][1 - first])


def test_episodes_of_preferences_are_paired():
    space = PreferenceSpace(("action", "steps"))
    env = TransformedEnv(
        make_mo_gym_env("Counting-v0", num_envs=4), Compose(PreferenceSampler(space))
    )

    policy = TensorDictModule(
        lambda preference: preference[..., :1], in_keys=["preference"], out_keys=["action"]
    )
    data = rollout_preferences(env, policy, space.corners(), max_steps=20, seed=3)
    steps = data["mask"].sum(-1)
    assert steps[0].equal(steps[1]) and len(set(steps[0].tolist())) > 1
    assert data["observation"][0, :, 0, 1].equal(steps[0].float())
    returns = (data["next", "reward"] * data["mask"].unsqueeze(-1)).sum(-2)
    # The action is the weight of the first objective: 4 of the environment's units, or 1.
    torch.testing.assert_close(returns[0, :, 0], 4.0 * steps[0])
    torch.testing.assert_close(returns[1, :, 0], 1.0 * steps[1])


def test_a_seed_gives_the_same_episodes():
    def lasts(seed: int) -> list[float]:
        env = make_mo_gym_env("Counting-v0", num_envs=8)
        env.set_seed(seed)
        return env.reset()["observation"][:, 1].tolist()

    assert lasts(0) == lasts(0) != lasts(1)


def test_discrete_actions_and_observations_of_any_kind():
    spaces = Dict(kind=Discrete(4), value=Box(-1, 1, (1,)))
    env = make_mo_gym_env(
        "Counting-v0", num_envs=2, actions=Discrete(3), observations=spaces, max_episode_steps=7
    )
    assert env.action_spec.shape == (2,) and env.action_spec.space.n == 3
    assert env.reset()["observation"][0].tolist() == [0.0, 0.0, 1.0, 0.0, 0.5]
    assert env.max_episode_steps == 7


@pytest.mark.parametrize(
    ("name", "arguments", "message"),
    [
        ("Contuing-v0", {}, "Contuing-v0 cannot be made: Environment `Contuing` doesn't exist"),
        ("no_such_module:A-v0", {}, "no_such_module:A-v0 cannot be made:"),
        ("Counting-v0", {"wheels": 3}, "Counting-v0 cannot be made: .*wheels"),
        ("Scalar-v0", {}, "Scalar-v0 has a scalar reward: its env.unwrapped.reward_space must be"),
        ("Endless-v0", {}, "Endless-v0 has no time limit: give max_episode_steps."),
        ("Counting-v0", {"actions": Box(-np.inf, np.inf, (1,))}, "a row of bounded numbers"),
        ("Counting-v0", {"actions": MultiDiscrete([2, 2])}, "must be a Box or Discrete"),
    ],
)
def test_what_does_not_fit_is_one_line(name, arguments, message):
    with pytest.raises(ValueError, match=message) as refused:
        make_mo_gym_env(name, **arguments)
    assert "\n" not in str(refused.value)


def test_what_mujoco_warns_of_is_said_once(capfd):
    make_mo_gym_env("mo-halfcheetah-v5", num_envs=3)
    said = capfd.readouterr()
    assert (said.out + said.err).count("settotalmass") == 1
