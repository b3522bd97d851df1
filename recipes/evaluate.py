"""Evaluate a policy: any preferences, scene, robot, drive and faults, one table.

Examples::

    python -m recipes.evaluate                                   # sweep efficiency -> distance
    python -m recipes.evaluate --scene moving_human
    python -m recipes.evaluate --preferences 1,0 0.5,0.5 --robot hsr --drive wheels
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
import tqdm

from envs import ROBOTS, SCENES, Perturbation
from torchrl_morl.deploy import load_policy

from .demo import GOAL_RADIUS, SHIPPED_POLICY
from .sweep import edge, sweep


def main() -> None:
    """Evaluate; ``--help`` lists the options."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--policy", type=Path, default=SHIPPED_POLICY, help="folder of the policy")
    parser.add_argument("--scene", default="static", help=f"one of {sorted(SCENES)}")
    parser.add_argument("--robot", default="turtlebot2", help=f"one of {sorted(ROBOTS)}")
    parser.add_argument("--drive", default="planar", help="planar or wheels")
    parser.add_argument("--episodes", type=int, default=100, help="scenes per preference")
    parser.add_argument("--seed", type=int, default=7, help="of the scenes")
    parser.add_argument(
        "--preferences",
        nargs="+",
        metavar="P",
        help="comma-separated weights in the order of the policy's tunable objectives "
        "(default: 11 from efficiency to distance)",
    )
    parser.add_argument("--range-noise", type=float, default=0.0, help="lidar noise, m")
    parser.add_argument("--dropout", type=float, default=0.0, help="share of lost lidar rays")
    parser.add_argument("--velocity-noise", type=float, default=0.0, help="share of the range")
    parser.add_argument("--latency", type=int, default=0, help="control steps, 0 or 1")
    args = parser.parse_args()

    torch.set_num_threads(1)
    actor, space, _ = load_policy(args.policy)
    if args.preferences:
        rows = [[float(value) for value in row.split(",")] for row in args.preferences]
        preferences = space.validate(torch.tensor(rows))
    else:
        preferences = edge(space, "efficiency", "distance")
    with tqdm.tqdm(total=len(preferences), unit="preference") as progress:
        result = sweep(
            actor,
            space,
            preferences,
            episodes=args.episodes,
            seed=args.seed,
            scene=args.scene,
            robot=args.robot,
            drive=args.drive,
            goal_radius=GOAL_RADIUS,
            perturbation=Perturbation(
                args.range_noise, args.dropout, args.velocity_noise, args.latency
            ),
            on_preference=lambda _: progress.update(),
        )
    print(result.table())
    metrics = result.metrics
    total = metrics["success"].numel()
    collisions = metrics["collision_human"] | metrics["collision_obstacle"]
    bound = (metrics["direct_distance"] - GOAL_RADIUS) / 0.5
    print(
        f"all {total} episodes: success {100 * metrics['success'].float().mean():.2f} %, "
        f"collisions {100 * collisions.float().mean():.2f} %, "
        f"timeouts {100 * metrics['timeout'].float().mean():.2f} %"
    )
    solved = metrics["success"][0]
    ratio = metrics["time"][0][solved].mean() / bound[0][solved].mean()
    print(
        f"first preference: mean time {metrics['time'][0].nanmean():.2f} s = {ratio:.3f} x "
        f"(start-goal distance - goal radius) / 0.5 m/s (n = {int(solved.sum())})"
    )


if __name__ == "__main__":
    main()
