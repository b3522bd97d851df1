"""A small batched environment, rollouts and their comparison."""

from __future__ import annotations

import functools

import mujoco
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Composite, Unbounded

from envs import BatchedMujocoEnv, NavigationEnv

# Few rays where the test is not about the lidar.
make_env = functools.partial(NavigationEnv, num_threads=1, num_rays=8, seed=0)


def random_actions(env: NavigationEnv, steps: int, seed: int = 0) -> torch.Tensor:
    """Forward speed and turn rate over the whole range of the robot, ``[steps, N, 2]``."""
    unit = torch.rand(steps, env.num_envs, 2, generator=torch.Generator().manual_seed(seed))
    return env.action_spec.space.low + unit * (
        env.action_spec.space.high - env.action_spec.space.low
    )


def follow(env, start: TensorDict, actions: torch.Tensor) -> list[TensorDict]:
    """What the environment returns for each action, without resets."""
    out, current = [], start
    for action in actions:
        current = env.step(current.set("action", action))["next"]
        out.append(current.clone())
    return out


def assert_same(first, second, rows=slice(None)):
    for step, (a, b) in enumerate(zip(first, second, strict=True)):
        assert set(a.keys(True, True)) == set(b.keys(True, True))
        for key in a.keys(True, True):
            assert torch.equal(a[key][rows], b[key][rows]), (step, key)


class Swing(BatchedMujocoEnv):
    """The smallest subclass: a pendulum, rewarded for height and for saving torque."""

    FRAME_SKIP = 3

    def _make_model(self):
        return mujoco.MjModel.from_xml_string(
            """<mujoco><worldbody><body><joint name="hinge" axis="0 1 0"/>
            <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.03"/></body></worldbody>
            <actuator><motor joint="hinge"/></actuator></mujoco>"""
        )

    def _sample_initial_state(self, ids, tensordict):
        qpos = torch.rand(len(ids), 1, generator=self.rng, dtype=torch.float64)
        return qpos, torch.zeros_like(qpos)

    def _make_obs_spec(self):
        return Composite(
            angle=Unbounded((self.num_envs, 1), dtype=self.dtype), shape=(self.num_envs,)
        )

    def _make_obs(self, ids=None):
        rows = slice(None) if ids is None else ids
        return {"angle": self._view["qpos"][rows].to(self.dtype)}

    def _make_action_spec(self):
        return Bounded(-1.0, 1.0, shape=(self.num_envs, 1), dtype=self.dtype)

    def _make_reward_spec(self):
        return Unbounded((self.num_envs, 2), dtype=self.dtype)

    def _compute_terminated(self, state, next_state):
        return next_state.qpos.abs() > 1.5

    def _compute_reward(self, state, action, next_state):
        return torch.cat((-next_state.qpos.cos(), -action.square()), dim=-1)
