"""Teach the robot your style: from recorded drives to a policy that drives so, and a picture of both.

Imports the drives, distils them into a reward model (D-REX), trains a policy that a preference makes
more or less like them (PD-MORL), evaluates it in fresh scenes, and draws your drives beside its own. About
ten minutes on two cores::

    python -m recipes.teach examples/drives_right.csv

``docs/how_to/style.md`` says what to record, and what to do where it does not work. The stages are recipes of
their own: ``--drex`` and ``--pd-morl`` pass overrides on to them.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import time
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import torch
import tqdm

from envs import HUMAN_RADIUS, SCENES, get_robot
from envs.demonstrations import import_demonstrations
from torchrl_morl.data import load_demonstrations, save_demonstrations
from torchrl_morl.deploy import load_policy

from . import stages
from .arguments import Parser, episodes, existing, existing_file
from .drex import schema as drex_schema
from .evaluation import style
from .evaluation.setting import choose
from .evaluation.sweep import Sweep, sweep
from .objectives import DEMO, known
from .outputs import claim_folder
from .pd_morl import schema as morl_schema
from .training.command import check_stage
from .training.quoting import quoted
from .training.run_folder import claim, final_policy


def main() -> None:
    """Teach; ``--help`` lists the options."""
    parser = Parser(description=__doc__)
    parser.add_argument("file", type=existing, help="recorded drives: .csv, .npz or a ROS bag")
    parser.add_argument("--boxes", type=existing_file, help="boxes around the drives, .csv")
    parser.add_argument("--robot", default="turtlebot2", help="that drove: a name or a .yaml file")
    parser.add_argument("--output", type=Path, help="new folder (default: one in runs/teach)")
    parser.add_argument(
        "--episodes", type=episodes, default=100, help="fresh scenes of the evaluation"
    )
    parser.add_argument("--full", action="store_true", help="full trainings instead of quick ones")
    parser.add_argument("--drex", nargs="*", default=[], help="overrides of recipes/drex")
    parser.add_argument("--pd-morl", nargs="*", default=[], help="overrides of recipes/pd_morl")
    args = parser.parse_args()
    started = time.perf_counter()
    base = Path("runs/teach")
    try:
        robot = get_robot(args.robot)
        drives, report = import_demonstrations(args.file, args.boxes, robot=robot)
        planned = base / "new" if args.output is None else args.output.resolve()
        stages.refuse_places("--drex", args.drex)
        stages.refuse_places("--pd-morl", args.pd_morl)
        check_stage("--drex", drex_schema, drex_command(args, planned)[1:], planned)
        check_stage("--pd-morl", morl_schema, morl_command(args, planned)[1:], planned)
        output = claim(base) if args.output is None else claim_folder(args.output, base)
    except (OSError, ValueError, ImportError) as error:
        parser.error(str(error))
    print(report)
    output = output.resolve()
    dataset = output / "demonstrations.safetensors"
    save_demonstrations(
        dataset,
        drives,
        {"source": args.file.name, "robot": args.robot, **dataclasses.asdict(report)},
    )
    stages.run("D-REX", drex_command(args, output))
    stages.run("PD-MORL", morl_command(args, output))
    policy = final_policy(output / "pd_morl")
    results = compare(policy, dataset, episodes=args.episodes)
    picture = output / "style.png"
    draw(picture, results)
    print(results.table())
    (output / "style.json").write_text(json.dumps(results.numbers(), indent=2) + "\n")
    print(f"picture: {picture}")
    print(f"policy: {policy} ({(time.perf_counter() - started) / 60:.1f} minutes)")
    print(f"try it: python -m recipes.demo --policy {policy}")
    if results.likeness < 0.9:
        print(
            f"warning: at demonstration = 1 only {100 * results.likeness:.0f} % pass on the "
            f"{results.shown.side} as shown: record more drives, or train longer (--full)."
        )


def drex_command(args: argparse.Namespace, output: Path) -> list[str]:
    """What distils the drives in ``output`` into a reward model."""
    return [
        "recipes.drex.drex",
        f"hydra.run.dir={quoted(output / 'drex')}",
        f"demonstrations.dataset={quoted(output / 'demonstrations.safetensors')}",
        *common(args),
        f"torch_threads={threads()}",
        *args.drex,
    ]


def morl_command(args: argparse.Namespace, output: Path) -> list[str]:
    """What trains a policy with that reward model."""
    return [
        "recipes.pd_morl.pd_morl",
        f"hydra.run.dir={quoted(output / 'pd_morl')}",
        f"demonstrations.reward_model={quoted(output / 'drex' / 'reward_model')}",
        f"demonstrations.dataset={quoted(output / 'demonstrations.safetensors')}",
        *common(args),
        f"compute.torch_threads={threads()}",
        *args.pd_morl,
    ]


def common(args: argparse.Namespace) -> list[str]:
    preset = [] if args.full else ["preset=quick"]
    return [*preset, f"env.robot={quoted(args.robot)}"]


def threads() -> int:
    return min(2, len(os.sched_getaffinity(0)))


@dataclasses.dataclass(frozen=True)
class Comparison:
    """Drives that were shown, and those of a policy that learned from them.

    Args:
        shown: the demonstrations.
        driven: those of the policy in scenes with boxes, by the objective that has all the weight.
        free: the same in scenes without boxes.
        success: share of the episodes with boxes that reach the goal, by objective.
    """

    shown: style.Drives
    driven: dict[str, style.Drives]
    free: dict[str, style.Drives]
    success: dict[str, float]

    @property
    def likeness(self) -> float:
        """Share of the drives at demonstration = 1 that pass on the side that was shown."""
        return self.driven[DEMO].on(self.shown.side)

    def numbers(self) -> dict[str, dict[str, float]]:
        """What :meth:`table` shows."""
        side = self.shown.side
        rows = {
            "shown": {
                f"passes on the {side}": self.shown.on(side),
                "nearest to the human / m": self.shown.nearest.mean().item(),
            }
        }
        for name, drives in self.driven.items():
            rows[name] = {
                "success": self.success[name],
                f"passes on the {side}": drives.on(side),
                f"passes on the {side}, without boxes": self.free[name].on(side),
                "nearest to the human / m": drives.nearest.mean().item(),
                "distance to what was shown / m": drives.distance_to(self.shown).nanmean().item(),
                "distance to what was shown, without boxes / m": self.free[name]
                .distance_to(self.shown)
                .nanmean()
                .item(),
            }
        return rows

    def table(self) -> str:
        """One line a preference."""
        lines = []
        for name, numbers in self.numbers().items():
            cells = (
                f"{what} {value:.2f}" if what.endswith("/ m") else f"{what} {100 * value:.0f} %"
                for what, value in numbers.items()
            )
            lines.append(f"{name:>12}: {'; '.join(cells)}")
        return "\n".join(lines)


def compare(policy: Path, dataset: Path, *, episodes: int, seed: int = 7) -> Comparison:
    """Drive the corner preferences of a policy in fresh scenes, with boxes and without."""
    torch.set_num_threads(1)
    loaded = load_policy(policy)
    setting = choose(loaded.card)
    data, _ = load_demonstrations(dataset)
    corners = loaded.preference_space.corners()
    results: list[Sweep] = []
    with tqdm.tqdm(total=2 * len(corners), desc="evaluation", unit="preference") as progress:
        for scene in (setting.scene, SCENES["empty"]):
            results.append(
                sweep(
                    loaded.actor,
                    loaded.preference_space,
                    corners,
                    episodes=episodes,
                    seed=seed,
                    on_preference=lambda _: progress.update(),
                    **{**setting.arguments, "scene": scene},
                )
            )
    drives = [
        {
            name: style.of_sweep(result.paths, result.scenes, row)
            for row, name in enumerate(loaded.preference_space.tunable)
        }
        for result in results
    ]
    success = results[0].metrics["success"].float().mean(-1).tolist()
    return Comparison(
        style.of_demonstrations(data),
        *drives,
        success=dict(zip(loaded.preference_space.tunable, success, strict=True)),
    )


def draw(path: Path, results: Comparison) -> None:
    """The drives that were shown, and those of every corner preference, in scenes without boxes."""
    objectives = known(results.free)
    fig, axes = plt.subplots(
        1, 1 + len(objectives), figsize=(3.6 * (1 + len(objectives)), 3.6), sharex=True, sharey=True
    )
    panels = [("your drives", "black", results.shown)]
    panels += [(f"{one.label} = 1", one.color, results.free[one.name]) for one in objectives]
    for ax, (title, color, drives) in zip(axes, panels, strict=True):
        for behind in () if drives is results.shown else range(len(results.shown)):
            points = results.shown.position[behind][results.shown.mask[behind]]
            ax.plot(*points.T, color="0.8", linewidth=0.8)
        for position, mask in zip(drives.position[:40], drives.mask[:40]):
            ax.plot(*position[mask].T, color=color, linewidth=1.2, alpha=0.5)
        ax.add_patch(plt.Circle((0, 0), HUMAN_RADIUS, color="#d55e00", zorder=4))
        ax.set_title(title)
        ax.set_aspect("equal")
        ax.set_xlim(-4, 4)
        ax.set_ylim(-3.2, 3.2)
        ax.set_xlabel("m, towards the goal")
        ax.grid(alpha=0.3)
    axes[0].set_ylabel("m, to the left")
    fig.suptitle(
        "Every drive seen from the human (orange); your drives in grey. "
        f"At demonstration = 1, {100 * results.free[DEMO].on(results.shown.side):.0f} % pass on the "
        f"{results.shown.side}, as you did.",
        fontsize=11,
    )
    fig.tight_layout(h_pad=0.5)
    fig.savefig(path, dpi=110)
    plt.close(fig)


if __name__ == "__main__":
    main()
