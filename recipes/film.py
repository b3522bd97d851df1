"""Film one policy in one scene, preference after preference.

Example::

    python -m recipes.film --policy recipes/policies/moving_humans --scene moving_human --output walking.gif
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch

from envs import ROBOTS, SCENES
from torchrl_morl.deploy import load_policy

from .demo.film import film
from .evaluation.sweep import SHIPPED_POLICY, observed_by


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


if __name__ == "__main__":
    main()
