"""Evaluate a policy: any preferences, scene, robot, drive and faults, one table.

Examples::

    python -m recipes.evaluate                                   # sweep efficiency -> distance
    python -m recipes.evaluate --scene moving_human
    python -m recipes.evaluate --preferences 1,0 0.5,0.5 --robot hsr --drive wheels
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import get_args

import torch
import tqdm
from torch import Tensor

from envs import ROBOTS, SCENES, Faults
from envs.demonstrations import CircleDemonstrator
from envs.mjcf import Drive
from torchrl_morl.deploy import load_policy
from torchrl_morl.preferences import PreferenceSpace

from .evaluation.sweep import GOAL_RADIUS, SHIPPED_POLICY, edge, observed_by, sweep


def parse_preferences(texts: list[str], preference_space: PreferenceSpace) -> Tensor:
    """Preferences ``[P, T]`` written as ``0.5,0.5``.

    Raises:
        ValueError: if one is not a list of numbers, or off the simplex.
    """
    rows = []
    for text in texts:
        try:
            rows.append(preference_space.validate([float(value) for value in text.split(",")]))
        except ValueError as error:
            raise ValueError(f"--preferences {text}: {error}") from error
    return torch.stack(rows)


def main() -> None:
    """Evaluate; ``--help`` lists the options."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--policy", type=Path, default=SHIPPED_POLICY, help="folder of the policy")
    parser.add_argument("--scene", default="static", choices=sorted(SCENES))
    parser.add_argument("--robot", default="turtlebot2", choices=sorted(ROBOTS))
    parser.add_argument("--drive", default="planar", choices=get_args(Drive))
    parser.add_argument("--episodes", type=int, default=100, help="scenes per preference")
    parser.add_argument("--seed", type=int, default=7, help="of the scenes")
    parser.add_argument(
        "--preferences",
        nargs="+",
        metavar="P",
        help="comma-separated weights in the order of the policy's tunable objectives "
        "(default: 11 from efficiency to distance)",
    )
    parser.add_argument(
        "--grid", action="store_true", help="the test grid of the paper: all edges, 11 steps each"
    )
    parser.add_argument("--range-noise", type=float, default=0.0, help="lidar noise, m")
    parser.add_argument("--dropout", type=float, default=0.0, help="share of lost lidar rays")
    parser.add_argument("--velocity-noise", type=float, default=0.0, help="share of the range")
    parser.add_argument("--latency", type=int, default=0, help="control steps, 0 or 1")
    args = parser.parse_args()

    torch.set_num_threads(1)
    try:
        actor, preference_space, card = load_policy(args.policy)
        demonstrator = None
        if "demonstrator" in card:
            demonstrator = CircleDemonstrator(**card["demonstrator"] | {"robot": args.robot})
        if args.preferences:
            preferences = parse_preferences(args.preferences, preference_space)
        elif args.grid:
            preferences = preference_space.pairwise_grid(11)
        else:
            preferences = edge(preference_space, "efficiency", "distance")
        faults = Faults(args.range_noise, args.dropout, args.velocity_noise, args.latency)
        if args.episodes < 1:
            raise ValueError(f"--episodes must be at least 1, got {args.episodes}.")
    except (OSError, ValueError) as error:
        parser.error(str(error))
    with tqdm.tqdm(total=len(preferences), unit="preference") as progress:
        result = sweep(
            actor,
            preference_space,
            preferences,
            episodes=args.episodes,
            seed=args.seed,
            scene=args.scene,
            robot=args.robot,
            drive=args.drive,
            goal_radius=GOAL_RADIUS,
            faults=faults,
            demonstrator=demonstrator,
            on_preference=lambda _: progress.update(),
            **observed_by(card),
        )
    print(result.table())
    metrics = result.metrics
    total = metrics["success"].numel()
    collisions = metrics["collision_human"] | metrics["collision_obstacle"]
    print(
        f"all {total} episodes: success {100 * metrics['success'].float().mean():.2f} %, "
        f"collisions {100 * collisions.float().mean():.2f} %, "
        f"timeouts {100 * metrics['timeout'].float().mean():.2f} %"
    )
    fastest = preferences[:, preference_space.tunable.index("efficiency")].argmax()
    solved = metrics["success"][fastest]
    time = metrics["time"][fastest][solved].mean()
    bound = ((metrics["direct_distance"][fastest] - GOAL_RADIUS) / 0.5)[solved].mean()
    print(
        f"preference {preferences[fastest].tolist()}: mean time {time:.2f} s = {time / bound:.3f} x "
        f"(start-goal distance - goal radius) / 0.5 m/s (n = {int(solved.sum())})"
    )


if __name__ == "__main__":
    main()
