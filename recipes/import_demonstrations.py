"""Turn recorded trajectories (.csv or .npz) into a demonstrations file for D-REX.

``docs/demonstrations.md`` describes the formats and what makes a trajectory fit.
"""

from __future__ import annotations

import dataclasses
import functools
import tempfile
from pathlib import Path

import torch
import tqdm
from safetensors import SafetensorError

from envs import get_robot
from envs.demonstrations import NoDriveAcceptedError, Tolerances, import_demonstrations
from torchrl_morl.data import save_demonstrations

from .arguments import Parser


def check_output(path: Path) -> None:
    """Whether the file can be written, before any work is done.

    Raises:
        ValueError: if it is no new ``.safetensors`` file in a folder that can be written.
    """
    if path.suffix != ".safetensors":
        raise ValueError(f"--output {path}: demonstrations are a .safetensors file.")
    if path.exists():
        raise ValueError(f"{path} exists and is not overwritten: choose another name.")
    folder = next(parent for parent in path.absolute().parents if parent.exists())
    try:
        # Permissions alone do not tell: root has them all, also where nothing can be written.
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise ValueError(
            f"--output {path}: {folder} is not a folder that can be written: {error.strerror}."
        ) from error


def main() -> None:
    """Import a file; ``--help`` lists the options."""
    parser = Parser(description=__doc__.split("\n\n")[0])
    parser.add_argument("file", type=Path, help="recorded trajectories, .csv or .npz")
    parser.add_argument("--output", type=Path, required=True, help=".safetensors file to write")
    parser.add_argument("--boxes", type=Path, help="boxes around a .csv file's trajectories, .csv")
    parser.add_argument("--robot", default="turtlebot2", help="whose limits and lidar count")
    parser.add_argument("--goal-radius", type=float, default=0.3, help="metres")
    parser.add_argument(
        "--max-steps", type=int, default=300, help="longest drive, control steps of 0.2 s"
    )
    for field in dataclasses.fields(Tolerances):
        parser.add_argument(
            f"--{field.name.replace('_', '-')}-tolerance", type=float, default=field.default
        )
    parser.add_argument("--verbose", action="store_true", help="a line on each rejected drive")
    args = parser.parse_args()

    torch.set_num_threads(1)
    try:
        check_output(args.output)
        tolerances = Tolerances(
            **{f.name: getattr(args, f"{f.name}_tolerance") for f in dataclasses.fields(Tolerances)}
        )
        data, report = import_demonstrations(
            args.file,
            args.boxes,
            robot=get_robot(args.robot),
            goal_radius=args.goal_radius,
            max_steps=args.max_steps,
            tolerances=tolerances,
            # Nothing is shown of what takes less than two seconds, or goes into a file.
            progress=functools.partial(tqdm.tqdm, delay=2.0, disable=None, leave=False),
        )
        metadata = {
            "source": args.file.name,
            "boxes": args.boxes.name if args.boxes else None,
            "robot": args.robot,
            "goal_radius": args.goal_radius,
            "max_steps": args.max_steps,
            "tolerances": dataclasses.asdict(tolerances),
            "accepted": report.accepted,
            "rejected": {name: list(map(str, why)) for name, why in report.rejected.items()},
            "notes": list(report.notes),
        }
        save_demonstrations(args.output, data, metadata)
    except NoDriveAcceptedError as error:
        details = [f"  {line}" for line in error.report.details()] if args.verbose else []
        parser.error("\n".join([str(error), *details]))
    except (ValueError, OSError, SafetensorError) as error:
        parser.error(str(error))
    except KeyboardInterrupt:
        parser.exit(130, f"{parser.prog}: interrupted, nothing is written\n")
    print(report)
    for line in report.details() if args.verbose else ():
        print(f"  {line}")
    print(f"Demonstrations {list(data.shape)}: {args.output}")


if __name__ == "__main__":
    main()
