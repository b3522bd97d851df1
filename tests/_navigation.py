"""A navigation environment in a given place, and a few steps in it."""

from __future__ import annotations

import functools

import torch
from tensordict import TensorDict

from envs import NavigationEnv

F64 = torch.float64
# Float64 leaves rounding of the simulation alone in comparisons with closed forms.
make_env = functools.partial(NavigationEnv, num_threads=1, seed=0, dtype=F64)


def place(env: NavigationEnv, pose, **scene) -> TensorDict:
    """Start an episode with the robots at ``pose`` (x, y, heading), and goal, human or boxes given."""
    start = env.reset()
    start["qpos"] = torch.as_tensor(pose, dtype=F64).expand(env.num_envs, 3).clone()
    for key, value in scene.items():
        key = "human_pose" if key == "human" else ("scene", key)
        start[key] = torch.as_tensor(value, dtype=F64).expand(start[key].shape).clone()
    return env.reset(start, set_state=True)


def drive(env: NavigationEnv, current: TensorDict, action, steps: int) -> TensorDict:
    """The next ``steps`` transitions under one action, without resets, ``[N, steps]``."""
    action = torch.as_tensor(action, dtype=env.dtype).expand(env.num_envs, 2)
    out = []
    for _ in range(steps):
        current = env.step(current.set("action", action.clone()))["next"]
        out.append(current.clone())
    return torch.stack(out, 1)


def random_drive(env: NavigationEnv, current: TensorDict, steps: int) -> TensorDict:
    out = []
    for _ in range(steps):
        current = env.step(current.set("action", env.action_spec.rand()))["next"]
        out.append(current.clone())
    return torch.stack(out, 1)
