"""Turn recorded trajectories (.csv or .npz) into a demonstrations file for D-REX.

``docs/demonstrations.md`` describes the formats and what makes a trajectory fit.
"""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path

import torch

from envs import ROBOTS
from envs.demonstrations.feasibility import Tolerances
from envs.demonstrations.importer import import_demonstrations
from torchrl_morl.data import save_demonstrations


def main() -> None:
    """Import a file; ``--help`` lists the options."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("file", type=Path, help="recorded trajectories, .csv or .npz")
    parser.add_argument("--output", type=Path, required=True, help=".safetensors file to write")
    parser.add_argument("--boxes", type=Path, help="boxes around a .csv file's trajectories, .csv")
    parser.add_argument("--robot", choices=sorted(ROBOTS), default="turtlebot2")
    parser.add_argument("--goal-radius", type=float, default=0.3, help="metres")
    for field in dataclasses.fields(Tolerances):
        parser.add_argument(
            f"--{field.name.replace('_', '-')}-tolerance", type=float, default=field.default
        )
    args = parser.parse_args()
    if args.output.exists():
        parser.error(f"{args.output} exists and is not overwritten: choose another name.")

    torch.set_num_threads(1)
    try:
        tolerances = Tolerances(
            **{f.name: getattr(args, f"{f.name}_tolerance") for f in dataclasses.fields(Tolerances)}
        )
        data, report = import_demonstrations(
            args.file,
            args.boxes,
            robot=args.robot,
            goal_radius=args.goal_radius,
            tolerances=tolerances,
        )
    except (ValueError, FileNotFoundError) as error:
        parser.error(str(error))
    metadata = {
        "source": args.file.name,
        "boxes": args.boxes.name if args.boxes else None,
        "robot": args.robot,
        "goal_radius": args.goal_radius,
        "tolerances": dataclasses.asdict(tolerances),
        **dataclasses.asdict(report),
    }
    save_demonstrations(args.output, data, metadata)
    print(report)
    print(f"Demonstrations {list(data.shape)}: {args.output}")


if __name__ == "__main__":
    main()
