"""Drives that were shown beside those of a policy that learned from them: numbers and a picture."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import torch
import tqdm

from envs import HUMAN_RADIUS, SCENES
from torchrl_morl.data import load_demonstrations
from torchrl_morl.deploy import load_policy

from ..objectives import DEMO, known
from . import style
from .setting import choose
from .sweep import Sweep, sweep


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
        """Shares, and mean distances in metres: of what was shown, and by objective."""
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


def table(numbers: Mapping[str, Mapping[str, float]]) -> str:
    """One line a preference, of :meth:`Comparison.numbers`.

    Examples:
        >>> table({"shown": {"passes on the right": 0.95, "nearest to the human / m": 1.3}})
        '       shown: passes on the right 95 %; nearest to the human / m 1.30'
    """
    lines = []
    for name, values in numbers.items():
        cells = (
            f"{what} {value:.2f}" if what.endswith("/ m") else f"{what} {100 * value:.0f} %"
            for what, value in values.items()
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
        *(1, 1 + len(objectives)),
        figsize=(3.6 * (1 + len(objectives)), 3.9),
        sharex=True,
        sharey=True,
        layout="constrained",
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
    fig.savefig(path, dpi=110)
    plt.close(fig)
