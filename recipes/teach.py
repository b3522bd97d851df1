"""Teach the robot your style: from recorded drives to a policy that drives so, and a picture of both.

Imports the drives, distils them into a reward model (D-REX), trains a policy that a preference makes
more or less like them (MO-PPO), evaluates it in fresh scenes, and draws your drives beside its own. About
ten minutes of one core::

    python -m recipes.teach examples/drives_right.csv
    python -m recipes.teach --resume runs/teach/2026-01-31_12-00-00    # one that was stopped

``docs/how_to/style.md`` says what to record, and what to do where it does not work. The stages are recipes of
their own: ``--drex`` and ``--mo-ppo`` pass overrides on to them.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import json
import os
import shlex
import time
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

from tensordict import TensorDict

from envs import get_robot
from envs.demonstrations import ImportReport, import_demonstrations
from torchrl_morl.data import save_demonstrations

from . import stages
from .arguments import Parser, episodes, existing, existing_file, existing_folder
from .drex import schema as drex_schema
from .evaluation.comparison import compare, draw, table
from .mo_ppo import schema as mo_ppo_schema
from .record import Record, begin, locked, refuse_used, to_resume
from .training.command import check_stage
from .training.quoting import quoted
from .training.run_folder import final_policy, write_atomically

_RUNS = Path("runs/teach")
_DATASET = "demonstrations.safetensors"
_QUICK = (
    "collector.total_frames=3_276_800",
    "evaluation.interval=655_360",
    "evaluation.episodes=50",
)
_SET_HERE = ("env.robot", "demonstrations.dataset", "demonstrations.reward_model")


def main() -> None:
    """Teach; ``--help`` lists the options."""
    parser = make_parser()
    args = parser.parse_args()
    try:
        record, held = resumed(args) if args.resume else begun(args)
    except (OSError, ValueError, ImportError) as error:
        parser.error(" ".join(str(error).split()))
    with held, stages.says_how_to_go_on(record, "recipes.teach"):
        teach(record)


def make_parser() -> Parser:
    parser = Parser(description=__doc__)
    parser.add_argument(
        "file", nargs="?", type=existing, help="recorded drives: .csv, .npz or a ROS bag"
    )
    parser.add_argument("--boxes", type=existing_file, help="boxes around the drives, .csv")
    parser.add_argument("--robot", default="turtlebot2", help="that drove: a name or a .yaml file")
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--output", type=Path, help="new folder (default: one in runs/teach)")
    where.add_argument(
        "--resume", type=existing_folder, help="folder of an unfinished lesson to go on with"
    )
    parser.add_argument(
        "--episodes", type=episodes, default=100, help="fresh scenes of the evaluation"
    )
    parser.add_argument(
        "--full", action="store_true", help="a training of full length instead of a quick one"
    )
    parser.add_argument("--drex", nargs="*", default=[], help="overrides of recipes/drex")
    parser.add_argument("--mo-ppo", nargs="*", default=[], help="overrides of recipes/mo_ppo")
    return parser


def begun(args: argparse.Namespace) -> tuple[Record, IO[str]]:
    """A new lesson, whose drives and stages have all been checked, in a folder of its own, and its lock.

    Raises:
        ValueError: for drives, a folder or an override that is refused.
    """
    if args.file is None:
        raise ValueError("file must be given: recorded drives, or --resume and a folder.")
    options = {
        "file": str(args.file.resolve()),
        "boxes": None if args.boxes is None else str(args.boxes.resolve()),
        "robot": str(Path(args.robot).resolve()) if Path(args.robot).is_file() else args.robot,
        "episodes": args.episodes,
        "full": args.full,
        "drex": args.drex,
        "mo_ppo": args.mo_ppo,
    }
    if args.output is not None:
        refuse_used(args.output)
    drives, report = recorded(options)
    check(options, _RUNS / "new" if args.output is None else args.output.resolve())
    record, held = begin(_RUNS, args.output, options, "recipes.teach")
    keep(record, drives, report)
    return record, held


def resumed(args: argparse.Namespace) -> tuple[Record, IO[str]]:
    """A lesson that has begun, with the options that it was given then, and its lock.

    Raises:
        ValueError: if it is over, if it is none, or for options that would change it.
    """
    record = to_resume(
        args.resume,
        file=str,
        boxes=(str, type(None)),
        robot=str,
        episodes=int,
        full=bool,
        drex=list,
        mo_ppo=list,
    )
    if make_parser().changed(args) - {"resume"}:
        raise ValueError("--resume goes on with the file and options of the start: give no others.")
    check(record.options, record.folder)
    held = locked(record)
    record = Record.load(record.folder)
    if not (record.folder / _DATASET).is_file():
        keep(record, *recorded(record.options))
    return record, held


def recorded(options: Mapping[str, Any]) -> tuple[TensorDict, ImportReport]:
    """The drives, replayed, and what became of each.

    Raises:
        ValueError: if none of them fits.
    """
    return import_demonstrations(
        options["file"], options["boxes"], robot=get_robot(options["robot"])
    )


def keep(record: Record, drives: TensorDict, report: ImportReport) -> None:
    """Save the drives for both stages, and say what became of them."""
    print(report)
    about = {"source": Path(record.options["file"]).name, "robot": record.options["robot"]}
    save_demonstrations(record.folder / _DATASET, drives, about | dataclasses.asdict(report))


def check(options: Mapping[str, Any], output: Path) -> None:
    """Refuse what a stage would refuse, before the first of them begins.

    Raises:
        ValueError: in one line.
    """
    for option, given in (("--drex", options["drex"]), ("--mo-ppo", options["mo_ppo"])):
        stages.refuse_places(option, given)
        for one in given:
            if one.partition("=")[0].lstrip("+") in _SET_HERE:
                raise ValueError(f"{option} {one}: that is set by recipes.teach, leave it out.")
    check_stage("--drex", drex_schema, drex_command(options, output / "drex")[1:], output)
    check_stage("--mo-ppo", mo_ppo_schema, mo_ppo_command(options, output / "mo_ppo")[1:], output)


def teach(record: Record) -> None:
    """Run the stages that are not finished, then compare the policy with the drives."""
    started = time.perf_counter()
    options, output = record.options, record.folder
    stages.stage(record, "D-REX", "drex", functools.partial(drex_command, options))
    ppo = stages.stage(record, "MO-PPO", "mo_ppo", functools.partial(mo_ppo_command, options))
    policy = final_policy(ppo)
    results = compare(policy, output / _DATASET, episodes=options["episodes"])
    picture = output / "style.png"
    draw(picture, results)
    numbers = results.numbers()
    write_atomically(output / "style.json", json.dumps(numbers, indent=2) + "\n")
    record.finished = True
    record.save()
    print(table(numbers))
    print(f"picture: {picture}")
    print(f"policy: {policy} ({(time.perf_counter() - started) / 60:.1f} minutes)")
    print(f"try it: python -m recipes.demo --policy {shlex.quote(str(policy))}")
    if results.likeness < 0.9:
        print(
            f"warning: at demonstration = 1 only {100 * results.likeness:.0f} % pass on the "
            f"{results.shown.side} as shown: record more drives, or train longer (--full)."
        )


def drex_command(options: Mapping[str, Any], folder: Path) -> list[str]:
    """What distils the drives beside a folder into a reward model in it."""
    return [
        "recipes.drex.drex",
        f"hydra.run.dir={quoted(folder)}",
        # What a clone learns from, and a reward model that a noisy learner can follow.
        *stages.preset(options["drex"], "tracked"),
        f"demonstrations.dataset={quoted(folder.parent / _DATASET)}",
        f"env.robot={quoted(options['robot'])}",
        f"torch_threads={threads()}",
        *options["drex"],
    ]


def mo_ppo_command(options: Mapping[str, Any], folder: Path) -> list[str]:
    """What trains a policy with that reward model."""
    drex = folder.parent / "drex"
    return [
        "recipes.mo_ppo.mo_ppo",
        f"hydra.run.dir={quoted(folder)}",
        *stages.preset(options["mo_ppo"], "nothing"),
        *([] if options["full"] else _QUICK),
        f"demonstrations.reward_model={quoted(drex / 'reward_model')}",
        f"demonstrations.dataset={quoted(drex / 'tracked.safetensors')}",
        f"env.robot={quoted(options['robot'])}",
        f"compute.torch_threads={threads()}",
        *options["mo_ppo"],
    ]


def threads() -> int:
    return min(2, len(os.sched_getaffinity(0)))


if __name__ == "__main__":
    main()
