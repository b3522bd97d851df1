"""Turn recorded trajectories (.csv, .npz or a ROS bag) into a demonstrations file for D-REX.

``docs/demonstrations.md`` describes the formats and what makes a trajectory fit.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import tempfile
from pathlib import Path

import torch
import tqdm
from safetensors import SafetensorError

from envs import get_robot
from envs.demonstrations import BagTopics, NoDriveAcceptedError, Tolerances, import_demonstrations
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


def chosen_topics(args: argparse.Namespace) -> BagTopics | None:
    """The topics of a bag, ``None`` for another file.

    Raises:
        ValueError: for no file or two, topics that are the same, or topics without a bag.
    """
    if (args.file is None) == (args.bag is None):
        given = "none" if args.file is None else f"{args.file} and --bag {args.bag}"
        raise ValueError(f"one file of trajectories or one --bag is needed, got {given}.")
    given = {
        name: getattr(args, option)
        for name, option in _TOPICS.items()
        if getattr(args, option) is not None
    }
    if args.bag is None:
        if given:
            option = "--" + _TOPICS[next(iter(given))].replace("_", "-")
            raise ValueError(f"{option} is for --bag: {args.file} has no topics.")
        return None
    if given.get("goal") == "none":
        given["goal"] = None
    return BagTopics(**given)


_TOPICS = {
    "robot": "robot_topic",
    "human": "human_topic",
    "goal": "goal_topic",
    "stamps": "stamps",
}
"""Fields of ``BagTopics`` and their options."""


def main() -> None:
    """Import a file; ``--help`` lists the options."""
    parser = Parser(description=__doc__.split("\n\n")[0])
    parser.add_argument("file", type=Path, nargs="?", help="recorded trajectories, .csv or .npz")
    parser.add_argument(
        "--bag", type=Path, help="instead of a file: a ROS bag, or a folder of bags"
    )
    parser.add_argument("--output", type=Path, required=True, help=".safetensors file to write")
    parser.add_argument("--boxes", type=Path, help="boxes around the trajectories, .csv")
    parser.add_argument("--robot", default="turtlebot2", help="whose limits and lidar count")
    parser.add_argument("--goal-radius", type=float, default=0.3, help="metres")
    parser.add_argument(
        "--max-steps", type=int, default=300, help="longest drive, control steps of 0.2 s"
    )
    parser.add_argument("--robot-topic", help="of the bag: Odometry or a pose (default /odom)")
    parser.add_argument("--human-topic", help="a pose, PoseArray or People (default /human)")
    parser.add_argument(
        "--goal-topic", help="a pose that begins a drive (default /goal_pose); none: stands do"
    )
    parser.add_argument("--stamps", help="of the messages: header (default) or received")
    for field in dataclasses.fields(Tolerances):
        parser.add_argument(
            f"--{field.name.replace('_', '-')}-tolerance", type=float, default=field.default
        )
    parser.add_argument("--verbose", action="store_true", help="a line on each rejected drive")
    args = parser.parse_args()

    torch.set_num_threads(1)
    try:
        check_output(args.output)
        topics, file = chosen_topics(args), args.bag or args.file
        tolerances = Tolerances(
            **{f.name: getattr(args, f"{f.name}_tolerance") for f in dataclasses.fields(Tolerances)}
        )
        data, report = import_demonstrations(
            file,
            args.boxes,
            robot=get_robot(args.robot),
            goal_radius=args.goal_radius,
            max_steps=args.max_steps,
            tolerances=tolerances,
            topics=topics,
            # Nothing is shown of what takes less than two seconds, or goes into a file.
            progress=functools.partial(tqdm.tqdm, delay=2.0, disable=None, leave=False),
        )
        metadata = {
            "source": file.name,
            "topics": dataclasses.asdict(topics) if topics else None,
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
    except (ValueError, OSError, ImportError, SafetensorError) as error:
        parser.error(str(error))
    except KeyboardInterrupt:
        parser.exit(130, f"{parser.prog}: interrupted, nothing is written\n")
    print(report)
    for line in report.details() if args.verbose else ():
        print(f"  {line}")
    print(f"Demonstrations {list(data.shape)}: {args.output}")


if __name__ == "__main__":
    main()
