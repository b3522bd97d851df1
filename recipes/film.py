"""Film one policy in one scene, preference after preference.

Example::

    python -m recipes.film --policy recipes/policies/moving_humans --scene moving_human --output walking.gif
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import matplotlib as mpl
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.envs import step_mdp

from envs import ROBOTS, SCENES
from envs.policy_env import make_policy_env
from torchrl_morl.deploy import load_policy
from torchrl_morl.evaluation import PREFERENCE_COLORS
from torchrl_morl.evaluation.video import write_video
from torchrl_morl.preferences import PreferenceSpace
from torchrl_morl.transforms import PreferenceSampler

from .sweep import GOAL_RADIUS, SHIPPED_POLICY, observed_by


def main() -> None:
    """Film the corner preferences; ``--help`` lists the options."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--policy", type=Path, default=SHIPPED_POLICY, help="folder of the policy")
    parser.add_argument("--scene", default="showcase", choices=sorted(SCENES))
    parser.add_argument("--robot", default="turtlebot2", choices=sorted(ROBOTS))
    parser.add_argument("--seed", type=int, default=0, help="of the scene")
    parser.add_argument("--output", type=Path, required=True, help="file to write, .gif or .mp4")
    args = parser.parse_args()
    if args.output.suffix not in (".gif", ".mp4"):
        parser.error(f"--output must end in .gif or .mp4, got {args.output.name!r}.")
    if args.output.exists():
        parser.error(f"{args.output} exists and is not overwritten: choose another name.")
    torch.set_num_threads(1)
    try:
        actor, preference_space, card = load_policy(args.policy)
    except (OSError, ValueError) as error:
        parser.error(str(error))
    where = {"scene": args.scene, "robot": args.robot, "seed": args.seed}
    movie = film(
        args.output,
        actor,
        preference_space,
        preference_space.corners(),
        **where,
        **observed_by(card),
    )
    print(f"film: {movie}")


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


if __name__ == "__main__":
    main()
