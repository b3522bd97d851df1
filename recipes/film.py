"""Film one policy in one scene, preference after preference.

Example::

    python -m recipes.film --scene moving_human --output walking.gif
"""

from __future__ import annotations

from pathlib import Path

import torch

from envs import ROBOTS, SCENES
from envs.rendering import gl_context_type
from torchrl_morl.deploy import load_policy

from .arguments import Parser, seed
from .demo.film import film
from .evaluation.setting import choose, demonstrator, reads_preference
from .evaluation.sweep import SHIPPED_POLICY
from .outputs import check_new_file
from .policy_folders import policy_folder


def main() -> None:
    """Film the corner preferences; ``--help`` lists the options."""
    parser = Parser(description=__doc__)
    parser.add_argument(
        "--policy", type=policy_folder, default=SHIPPED_POLICY, help="folder of the policy"
    )
    parser.add_argument("--scene", default="showcase", help=f"{', '.join(SCENES)}, or a .yaml file")
    parser.add_argument(
        "--robot", help=f"{', '.join(ROBOTS)}, or a .yaml file (default: that of the training)"
    )
    parser.add_argument(
        "--seed",
        type=seed,
        default=0,
        metavar="N",
        help="of the scene",
    )
    parser.add_argument("--output", type=Path, required=True, help="file to write, .gif or .mp4")
    args = parser.parse_args()
    if args.output.suffix not in (".gif", ".mp4"):
        parser.error(f"--output must end in .gif or .mp4, got {args.output.name!r}.")
    torch.set_num_threads(1)
    try:
        check_new_file(args.output)
        policy = load_policy(args.policy)
        gl_context_type()  # says what to install
        # Last, as it prints: what is refused says nothing else.
        setting = choose(policy.card, scene=args.scene, robot=args.robot, one_robot=True)
    except (OSError, RuntimeError, ValueError) as error:
        parser.error(str(error))
    preferences = policy.preference_space.corners()
    if not reads_preference(policy.card):
        print("note: this policy does not read the preference, the film shows one drive")
        preferences = preferences.mean(0, keepdim=True)
    try:
        movie = film(
            args.output,
            policy.actor,
            policy.preference_space,
            preferences,
            seed=args.seed,
            demonstrator=demonstrator(policy.card, setting.robot),
            **setting.arguments,
        )
    except (OSError, ValueError) as error:
        parser.error(str(error))
    print(f"film: {movie}")


if __name__ == "__main__":
    main()
