"""A preference changed while the robot drives."""

from __future__ import annotations

import dataclasses
from typing import Any

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.envs import step_mdp

from envs import NavigationEnv
from envs.metrics import trajectories
from envs.policy_env import make_policy_env
from torchrl_morl.evaluation import episode_mask
from torchrl_morl.geometry import wrap_angle
from torchrl_morl.preferences import PreferenceSpace
from torchrl_morl.transforms import PreferenceSampler


@dataclasses.dataclass(frozen=True)
class Switch:
    """Three runs in one scene: the first preference, the second, and the first then the second."""

    paths: TensorDict
    """``[3]``, see :func:`envs.metrics.trajectories`."""
    actions: Tensor
    """``[3, S, 2]``: m/s, rad/s."""
    switch_step: int
    """The step whose action is the first under the new preference."""

    @property
    def separation(self) -> float:
        """Distance from where the robot would have been, one second after the change, metres.

        NaN if a run of the two ends before that.
        """
        return self._second_after("position").norm().item()

    @property
    def turned(self) -> float:
        """By how much its heading differs then from what it would have been, degrees; or NaN."""
        return wrap_angle(self._second_after("heading")).abs().rad2deg().item()

    def _second_after(self, key: str) -> Tensor:
        """What differs one second after the change, from the run without it."""
        step = self.switch_step + round(1.0 / NavigationEnv.CONTROL_PERIOD)
        values, mask = self.paths[key], self.paths["mask"]
        if step >= mask.shape[1] or not mask[[0, 2], step].all():
            return torch.full_like(values[0, 0], torch.nan)
        return values[2, step] - values[0, step]


@torch.no_grad()
def switch(
    actor: TensorDictModule,
    preference_space: PreferenceSpace,
    preferences: Tensor,
    *,
    switch_step: int = 28,
    scene: str = "showcase",
    seed: int = 0,
    goal_radius: float = 0.3,
    max_episode_steps: int = 300,
    **env_kwargs: Any,
) -> Switch:
    """Drive through one scene under both preferences ``[2, T]``, and change between them.

    Other arguments are those of :func:`envs.policy_env.make_policy_env`.
    """
    env = make_policy_env(
        PreferenceSampler(preference_space),
        keep_simulation=True,
        num_envs=3,
        scene=scene,
        seed=seed,
        goal_radius=goal_radius,
        max_episode_steps=max_episode_steps,
        **env_kwargs,
    )
    start = TensorDict({"preference": preferences[[0, 1, 0]]}, batch_size=[3])
    data = env.reset(start, set_state=False)
    steps = []
    for step in range(max_episode_steps):
        if step == switch_step:
            data["preference"][2] = preferences[1]
        data = env.step(actor(data))
        steps.append(data.exclude("scan", ("next", "scan")).clone())
        ended = torch.stack([step["next", "done"] for step in steps]).any(0)
        if ended.all():
            break
        data = step_mdp(data)
    rollout = torch.stack(steps, dim=1)
    rollout["mask"] = episode_mask(rollout["next", "done"])
    low, high = env.base_env.action_spec.space.low[0], env.base_env.action_spec.space.high[0]
    env.close()
    return Switch(
        paths=trajectories(rollout),
        actions=low + (rollout["action"] + 1) / 2 * (high - low),
        switch_step=switch_step,
    )
