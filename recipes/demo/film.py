"""Film one policy in one scene, preference after preference."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib as mpl
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.envs import step_mdp

from envs.policy_env import make_policy_env
from recipes.evaluation.setting import GOAL_RADIUS
from torchrl_morl.evaluation import PREFERENCE_COLORS
from torchrl_morl.evaluation.video import write_video
from torchrl_morl.preferences import PreferenceSpace
from torchrl_morl.transforms import PreferenceSampler


@torch.no_grad()
def film(
    path: Path,
    actor: TensorDictModule,
    preference_space: PreferenceSpace,
    preferences: Tensor,
    *,
    scene: str = "showcase",
    goal_radius: float = GOAL_RADIUS,
    seed: int = 0,
    max_episode_steps: int = 300,
    every: int = 3,
    size: tuple[int, int] = (640, 360),
    **env_kwargs: Any,
) -> Path:
    """Drive through one scene under each preference ``[P, T]`` and film it with MuJoCo.

    The paths of earlier preferences stay on the floor. Every ``every``-th step is a frame. Other
    arguments are those of :func:`envs.policy_env.make_policy_env`.
    """
    env = make_policy_env(
        PreferenceSampler(preference_space),
        num_envs=1,
        scene=scene,
        seed=seed,
        goal_radius=goal_radius,
        max_episode_steps=max_episode_steps,
        **env_kwargs,
    )
    colors = mpl.colormaps[PREFERENCE_COLORS](torch.linspace(0, 1, len(preferences)).numpy())
    frames, trails = [], []
    for preference, color in zip(preferences, colors, strict=True):
        env.set_seed(seed)
        data = env.reset(TensorDict({"preference": preference[None]}, [1]), set_state=False)
        trail = []
        for step in range(max_episode_steps):
            trail.append(data["pose"][0, :2].clone())
            if step % every == 0 and step > 0:
                frames.append(
                    env.base_env.render(
                        camera="top",
                        width=size[0],
                        height=size[1],
                        preference=preference,
                        names=preference_space.tunable,
                        trails=[*trails, (torch.stack(trail), color[:3])],
                    )[0]
                )
            data = env.step(actor(data))
            if data["next", "done"].item():
                break
            data = step_mdp(data)
        trails.append((torch.stack(trail), color[:3]))
    env.close()
    return write_video(path, torch.stack(frames), fps=12)
