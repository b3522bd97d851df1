"""An environment of your own whose reward is a vector: a cart that is to be fast, and to spare its motor.

``python -m recipes.benchmark.train env=examples.my_environment:Cart-v0`` trains on it.
"""

import gymnasium
import numpy as np
from gymnasium.spaces import Box


class Cart(gymnasium.Env):
    observation_space = Box(-np.inf, np.inf, (1,))  # speed
    action_space = Box(-1.0, 1.0, (1,))  # force
    reward_space = Box(-np.inf, np.inf, (2,))  # one entry per objective: MO-Gymnasium's convention

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.speed = self.np_random.uniform(0.0, 0.2)
        return np.array([self.speed], np.float32), {}

    def step(self, action):
        force = float(np.clip(action[0], -1.0, 1.0))
        self.speed = 0.8 * self.speed + 0.2 * force
        reward = np.array([self.speed, -(force**2)], np.float32)  # fast, sparing
        terminated = truncated = False  # max_episode_steps truncates
        return np.array([self.speed], np.float32), reward, terminated, truncated, {}


gymnasium.register("Cart-v0", Cart, max_episode_steps=50)
