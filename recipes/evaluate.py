"""Evaluate a policy: any preferences, scene, robot, drive and faults, one table.

Examples::

    python -m recipes.evaluate                                   # sweep efficiency -> distance
    python -m recipes.evaluate --scene moving_human
    python -m recipes.evaluate --preferences 1,0,0 0,0.5,0.5 --robot hsr --drive wheels
"""

from __future__ import annotations

from typing import get_args

import torch
import tqdm
from torch import Tensor

from envs import ROBOTS, SCENES, Faults
from envs.mjcf import Drive
from torchrl_morl.deploy import load_policy
from torchrl_morl.preferences import PreferenceSpace

from .arguments import Parser, count, episodes, number, share
from .evaluation.setting import Setting, choose, demonstrator, reads_preference, scene_seed
from .evaluation.sweep import SHIPPED_POLICY, Sweep, edge, sweep
from .policy_folders import policy_folder


def parse_preferences(texts: list[str], preference_space: PreferenceSpace) -> Tensor:
    """Preferences ``[P, T]`` written as ``0.5,0.5``.

    Raises:
        ValueError: if one is not a list of numbers, or off the simplex.
    """
    rows = []
    for text in texts:
        try:
            weights = [float(value) for value in text.split(",")]
        except ValueError as error:
            names = ",".join(preference_space.tunable)
            raise ValueError(
                f"--preferences must be numbers, for {names}, with commas between, got {text!r}."
            ) from error
        try:
            rows.append(preference_space.validate(weights))
        except ValueError as error:
            raise ValueError(f"--preferences {text}: {error}") from error
    return torch.stack(rows)


def main() -> None:
    """Evaluate; ``--help`` lists the options."""
    parser = Parser(description=__doc__)
    parser.add_argument(
        "--policy", type=policy_folder, default=SHIPPED_POLICY, help="folder of the policy"
    )
    parser.add_argument(
        "--scene", help=f"{', '.join(SCENES)}, or a .yaml file (default: that of the training)"
    )
    parser.add_argument(
        "--robot", help=f"{', '.join(ROBOTS)}, any, or a .yaml file (default: that of the training)"
    )
    parser.add_argument("--drive", choices=get_args(Drive), help="default: that of the training")
    parser.add_argument("--episodes", type=episodes, default=100, help="scenes per preference")
    parser.add_argument("--seed", type=scene_seed, default=7, help="of the scenes")
    which = parser.add_mutually_exclusive_group()
    which.add_argument(
        "--preferences",
        nargs="+",
        metavar="P",
        help="comma-separated weights in the order of the policy's tunable objectives "
        "(default: 11 from the last objective to the one before it)",
    )
    which.add_argument(
        "--grid", action="store_true", help="the test grid of the paper: all edges, 11 steps each"
    )
    parser.add_argument("--range-noise", type=number(0), default=0.0, help="lidar noise, m")
    parser.add_argument("--dropout", type=share, default=0.0, help="share of lost lidar rays")
    parser.add_argument("--velocity-noise", type=number(0), default=0.0, help="share of the range")
    parser.add_argument("--latency", type=count(0, 3), default=0, help="control steps, 0 to 3")
    args = parser.parse_args()

    torch.set_num_threads(1)
    try:
        policy = load_policy(args.policy)
        if args.preferences:
            preferences = parse_preferences(args.preferences, policy.preference_space)
        elif args.grid:
            preferences = policy.preference_space.pairwise_grid(11)
        elif not reads_preference(policy.card):
            preferences = policy.preference_space.corners().mean(0, keepdim=True)
        else:
            # From the last objective to the one before it: efficiency to distance.
            last = policy.preference_space.tunable[-1]
            preferences = edge(
                policy.preference_space, last, policy.preference_space.tunable[-2:][0]
            )
        faults = Faults(args.range_noise, args.dropout, args.velocity_noise, args.latency)
        # Last, as it prints: what is refused says nothing else.
        setting = choose(policy.card, scene=args.scene, robot=args.robot, drive=args.drive)
    except (OSError, ValueError) as error:
        parser.error(str(error))
    if not reads_preference(policy.card):
        print("note: this policy does not read the preference, it drives the same under all")
    try:
        with tqdm.tqdm(total=len(preferences), unit="preference") as progress:
            result = sweep(
                policy.actor,
                policy.preference_space,
                preferences,
                episodes=args.episodes,
                seed=args.seed,
                faults=faults,
                demonstrator=demonstrator(policy.card, setting.robot),
                on_preference=lambda _: progress.update(),
                **setting.arguments,
            )
    except ValueError as error:  # of a scene from a file, which its first episode shows
        parser.error(str(error))
    print(result.table())
    metrics = result.metrics
    total = metrics["success"].numel()
    collisions = metrics["collision_human"] | metrics["collision_obstacle"]
    print(
        f"all {total} episodes: success {100 * metrics['success'].float().mean():.2f} %, "
        f"collisions {100 * collisions.float().mean():.2f} %, "
        f"timeouts {100 * metrics['timeout'].float().mean():.2f} %"
    )
    if "efficiency" in policy.preference_space.tunable:
        print(time_beside_the_straight_line(result, setting))


def time_beside_the_straight_line(result: Sweep, setting: Setting) -> str:
    """How long the preference takes that weighs efficiency most, and what a free way would take."""
    metrics = result.metrics
    differ = "robot" in result.scenes.keys()
    speed = result.scenes["robot"][:, 1].float() if differ else setting.robot.max_speed
    shown = "the robot's speed" if differ else f"{speed:g} m/s"
    entry = result.preference_space.tunable.index("efficiency")
    fastest = result.preferences[:, entry].argmax()
    solved = metrics["success"][fastest]
    if not solved.any():
        return f"preference {result.preferences[fastest].tolist()}: no episode reached the goal"
    time = metrics["time"][fastest][solved].mean()
    way = metrics["direct_distance"][fastest] - setting.goal_radius
    bound = (way / speed)[solved].mean()
    return (
        f"preference {result.preferences[fastest].tolist()}: mean time {time:.2f} s = "
        f"{time / bound:.3f} x (start-goal distance - goal radius) / {shown} "
        f"(n = {int(solved.sum())})"
    )


if __name__ == "__main__":
    main()
