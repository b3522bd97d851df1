"""Train a policy from nothing: demonstrations, D-REX, MO-PPO, evaluation.

``make train`` runs this. Every stage is a recipe of its own; options are passed on to them. PD-MORL, the
paper's method, can come before MO-PPO, or stand alone::

    python -m recipes.train
    python -m recipes.train --mo-ppo seed=1 collector.total_frames=4000000
    python -m recipes.train --with-pd-morl                    # MO-PPO polishes what PD-MORL has learned
    python -m recipes.train --without-mo-ppo                  # PD-MORL alone
    python -m recipes.train --resume runs/train/2026-01-31_12-00-00
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import shlex
from pathlib import Path
from typing import IO, Any

from . import stages
from .arguments import Parser, episodes, existing_folder
from .record import Record, begin, locked, refuse_used, to_resume
from .stages import refuse_places
from .training.quoting import quoted
from .training.run_folder import final_policy, last_policy

_RUNS = Path("runs/train")
_MODULES = {
    "D-REX": "recipes.drex.drex",
    "PD-MORL": "recipes.pd_morl.pd_morl",
    "MO-PPO": "recipes.mo_ppo.mo_ppo",
}
_FOLDERS = {"D-REX": "drex", "PD-MORL": "pd_morl", "MO-PPO": "mo_ppo"}


def main() -> None:
    """Run the stages one after the other; ``--help`` lists the options."""
    parser = make_parser()
    args = parser.parse_args()
    try:
        record, held = resumed(args) if args.resume else begun(args)
    except (OSError, ValueError) as error:
        parser.error(" ".join(str(error).split()))
    with held, stages.says_how_to_go_on(record, "recipes.train"):
        train(record)


def make_parser() -> Parser:
    parser = Parser(description=__doc__)
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--output", type=Path, help="folder to write; must not exist, or be empty")
    where.add_argument(
        "--resume", type=existing_folder, help="folder of an unfinished training to go on with"
    )
    parser.add_argument("--drex", nargs="*", default=[], help="overrides of recipes/drex")
    parser.add_argument("--pd-morl", nargs="*", default=[], help="overrides of recipes/pd_morl")
    parser.add_argument("--mo-ppo", nargs="*", default=[], help="overrides of recipes/mo_ppo")
    learners = parser.add_mutually_exclusive_group()
    learners.add_argument(
        "--with-pd-morl", action="store_true", help="PD-MORL first, which MO-PPO then polishes"
    )
    learners.add_argument(
        "--without-mo-ppo", action="store_true", help="PD-MORL alone, the paper's method"
    )
    learners.add_argument(
        "--paper",
        action="store_true",
        help="the same with the paper's own settings; three quarters of an hour",
    )
    parser.add_argument(
        "--episodes", type=episodes, default=100, help="of the final evaluation (default: 100)"
    )
    return parser


def begun(args: argparse.Namespace) -> tuple[Record, IO[str]]:
    """A new training, whose stages have all been checked, in a folder of its own, and its lock.

    Raises:
        ValueError: for an override that a stage refuses, or a folder that holds something.
    """
    alone = args.without_mo_ppo or args.paper
    with_pd_morl = alone or args.with_pd_morl
    if alone and args.mo_ppo:
        raise ValueError("PD-MORL alone leaves nothing that --mo-ppo could change: leave it out.")
    if args.pd_morl and not with_pd_morl:
        raise ValueError("--pd-morl changes nothing without PD-MORL: give --with-pd-morl, too.")
    options = {
        "drex": args.drex,
        "pd_morl": args.pd_morl,
        "mo_ppo": args.mo_ppo,
        "without_pd_morl": not with_pd_morl,
        "without_mo_ppo": alone,
        "paper": args.paper,
        "episodes": args.episodes,
    }
    if args.output is not None:
        refuse_used(args.output)
    check(options, args.output or _RUNS / "new")
    return begin(_RUNS, args.output, options, "recipes.train")


def resumed(args: argparse.Namespace) -> tuple[Record, IO[str]]:
    """A training that has begun, with the options that it was given then, and its lock.

    Raises:
        ValueError: if it is over, if it is none, or for options that would change it.
    """
    record = to_resume(
        args.resume,
        drex=list,
        pd_morl=list,
        mo_ppo=list,
        without_pd_morl=(bool, type(None)),  # of before there was such an option
        without_mo_ppo=bool,
        paper=(bool, type(None)),
        episodes=int,
    )
    if make_parser().changed(args) - {"resume"}:
        raise ValueError("--resume goes on with the options of the start: give no others.")
    check(record.options, record.folder)
    held = locked(record)
    # Another process may have gone on with it, and finished, in the meantime.
    return Record.load(record.folder), held


def check(options: dict[str, Any], output: Path) -> None:
    """Refuse what any of the stages would refuse, before the first of them begins.

    Raises:
        ValueError: in one line.
    """
    # They import PyTorch, which takes seconds that --help need not wait for.
    from envs.policy_env import SHOWN

    from .drex import schema as drex
    from .mo_ppo import schema as mo_ppo
    from .pd_morl import schema as pd_morl
    from .training.command import check_stage

    plan = Plan(Record(output, options))
    schemas = {"drex": drex, "pd_morl": pd_morl, "mo_ppo": mo_ppo}
    if options["without_mo_ppo"]:
        del schemas["mo_ppo"]
    if not plan.with_pd_morl:
        del schemas["pd_morl"]
    policy = output / "pd_morl" / "policies" / "last" if plan.with_pd_morl else None
    found = {}
    for name, module in schemas.items():
        refuse_places(f"--{name.replace('_', '-')}", options[name])
        command = {
            "drex": plan.drex,
            "pd_morl": plan.pd_morl,
            "mo_ppo": lambda folder: plan.mo_ppo(folder, policy),
        }[name](output / name)
        option = f"--{name.replace('_', '-')}"
        found[name] = check_stage(option, module, command[1:], output)
    learner = "pd_morl" if plan.with_pd_morl else "mo_ppo"
    for field in SHOWN:
        one, other = (found[name]["env"][field] for name in ("drex", learner))
        if other is None:  # as it is from nothing
            other = field == "observe_human"
        if one != other:
            option = f"--{learner.replace('_', '-')}"
            raise ValueError(
                f"env.{field} must be the same for --drex and {option}, got {one} and {other}."
            )


@dataclasses.dataclass(frozen=True)
class Plan:
    """The commands of the stages."""

    record: Record

    @property
    def threads(self) -> int:
        """The stages take turns: a second thread makes 1.36 times PD-MORL's updates on an idle machine."""
        return min(2, len(os.sched_getaffinity(0)))

    @property
    def with_pd_morl(self) -> bool:
        """A record without the option is of when there was no other way."""
        return not self.record.options.get("without_pd_morl", False)

    @property
    def paper(self) -> bool:
        """Whether everything is as the paper says."""
        return self.record.options.get("paper", False)

    def _preset(self, stage: str, name: str) -> list[str]:
        return stages.preset(self.record.options[stage], name)

    def made_by_drex(self) -> Path:
        return self.record.folder_of("D-REX") or self.record.folder / "drex"

    def drex(self, folder: Path) -> list[str]:
        return [
            _MODULES["D-REX"],
            f"hydra.run.dir={quoted(folder)}",
            *(self._preset("drex", "paper") if self.paper else []),
            # What a clone learns from, and a reward model that a noisy learner can follow.
            *([] if self.with_pd_morl else self._preset("drex", "tracked")),
            f"torch_threads={self.threads}",
            *self.record.options["drex"],
        ]

    def pd_morl(self, folder: Path) -> list[str]:
        drex = self.made_by_drex()
        if self.paper:
            # There demonstrations speak through the reward model alone.
            source = self._preset("pd_morl", "paper")
        else:
            source = [f"demonstrations.dataset={quoted(drex / 'demonstrations.safetensors')}"]
        return [
            _MODULES["PD-MORL"],
            f"hydra.run.dir={quoted(folder)}",
            f"demonstrations.reward_model={quoted(drex / 'reward_model')}",
            *source,
            f"compute.torch_threads={self.threads}",
            *self.record.options["pd_morl"],
        ]

    def mo_ppo(self, folder: Path, policy: Path | None) -> list[str]:
        drex = self.made_by_drex()
        if policy is None:
            start = [
                *self._preset("mo_ppo", "nothing"),
                f"demonstrations.dataset={quoted(drex / 'tracked.safetensors')}",
            ]
        else:
            start = [f"policy={quoted(policy)}"]
        return [
            _MODULES["MO-PPO"],
            f"hydra.run.dir={quoted(folder)}",
            *start,
            f"demonstrations.reward_model={quoted(drex / 'reward_model')}",
            *self.record.options["mo_ppo"],
        ]


def train(record: Record) -> None:
    """Run the stages that are not finished, and record each that is."""
    plan = Plan(record)
    stages.stage(record, "D-REX", _FOLDERS["D-REX"], plan.drex)
    policy = None
    if plan.with_pd_morl:
        trained = stages.stage(record, "PD-MORL", _FOLDERS["PD-MORL"], plan.pd_morl)
        policy = last_policy(trained) if plan.paper else final_policy(trained)
    if not record.options["without_mo_ppo"]:
        start = policy
        ppo = stages.stage(
            record, "MO-PPO", _FOLDERS["MO-PPO"], lambda folder: plan.mo_ppo(folder, start)
        )
        policy = final_policy(ppo)
    count = str(record.options["episodes"])
    command = ["recipes.evaluate", "--policy", str(policy), "--episodes", count, "--grid"]
    record.begin("evaluation", command, None)
    record.finish("evaluation", stages.run("evaluation", command))
    record.finished = True
    record.save()
    for name, entry in record.stages.items():
        print(f"{name:>12}: {entry['seconds'] / 60:6.1f} min")
    print(f"policy: {policy}\ntry it: python -m recipes.demo --policy {shlex.quote(str(policy))}")


if __name__ == "__main__":
    main()
