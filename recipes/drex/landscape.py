"""What a reward model pays: orbits, sides, speeds and policies, with a learner's noise and without.

A policy can only learn what its reward model pays most for, and only as far as its noise leaves a
difference::

    python -m recipes.drex.landscape runs/drex/reward_model --policies recipes/policies/polished_seed0
    python -m recipes.drex.landscape MODEL --noise 0 0 --noise 0.05 0.15 --output runs/landscape

Every driver drives in the same scenes, those whose demonstrated way no box blocks. Policies drive at
demonstration = 1. The numbers go to ``landscape.csv``, the picture to ``landscape.png``.
"""

from __future__ import annotations

import csv
import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import torch
import tqdm
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor

from envs.policy_env import check_policy
from envs.splits import check_test_seed
from recipes.arguments import Parser, episodes, existing_folder, number, seed
from recipes.objectives import DEMO
from recipes.outputs import claim_folder
from recipes.policy_folders import policy_folder
from torchrl_morl.deploy import load_policy, load_reward_model
from torchrl_morl.modules import RewardModel

from . import styles
from .demonstrations import demonstrated, demonstrator
from .ranking import step_scores
from .rollouts import frechet, rollouts, succeeded
from .tracking import disturbed

RADII = (0.7, 0.8, 0.9, 0.95, 1.05, 1.1, 1.2, 1.4)
"""Of other orbits, as shares of the demonstrated one."""

NEAR = 2.0
"""Metres from the human."""

GATE = 0.95
"""Least mean R of the demonstrator's steps, near the human and away from them."""

ARRIVES = 0.5
"""Least success of who is compared with the demonstrator."""

DEMONSTRATOR = "demonstrator"


@dataclasses.dataclass(frozen=True)
class Paid:
    """What a driver gets, means over scenes."""

    driver: str
    noise: tuple[float, float]
    """Standard deviation on speed and turn rate, in units of half their range."""
    episode: float
    """Sum of scale (R - 1) over an episode."""
    near: float
    """Mean R of the steps within :data:`NEAR` of the human."""
    far: float
    """Mean R of the others."""
    frechet: float
    """Distance from the demonstration, metres."""
    success: float
    """Share of episodes that reach the goal."""


def main() -> None:
    """Drive, and print what is paid; ``--help`` lists the options."""
    parser = Parser(description=__doc__)
    parser.add_argument("model", type=existing_folder, help="folder of a reward model")
    parser.add_argument(
        "--policies", type=policy_folder, nargs="+", default=[], help="folders of policies"
    )
    parser.add_argument(
        "--noise",
        type=number(least=0),
        nargs=2,
        action="append",
        metavar=("SPEED", "TURN"),
        help="of the learner, in units of half the range; may be given again (default: none, those of "
        "recipes.mo_ppo, and 0.2 0.25)",
    )
    parser.add_argument("--episodes", type=episodes, default=200, help="scenes, before the choice")
    parser.add_argument("--seed", type=seed, default=101, help="of the scenes, 7 to 9999")
    parser.add_argument(
        "--scale", type=number(above=0), default=10.0, help="what R = 0 costs a step"
    )
    parser.add_argument("--output", type=Path, help="new folder (default: one in runs)")
    args = parser.parse_args()
    torch.set_num_threads(1)
    noises = [tuple(one) for one in args.noise or ([0.0, 0.0], [0.05, 0.15], [0.2, 0.25])]
    try:
        model, card = load_reward_model(args.model)
        cfg = configuration(card, args.model)
        check_test_seed(args.seed)
        drivers = scripted(cfg) | given(cfg, args.policies)
        output = claim_folder(args.output, Path("runs/landscape"))
    except (OSError, ValueError) as error:
        parser.error(str(error))
    settings = [(name, noise) for noise in noises for name in drivers]
    rows = []
    for row in tqdm.tqdm(
        landscape(
            cfg, model, drivers, noises, count=args.episodes, seed=args.seed, scale=args.scale
        ),
        total=len(settings),
        desc="landscape",
        unit="driver",
    ):
        rows.append(row)
    write_csv(output / "landscape.csv", rows)
    figure(output / "landscape.png", rows)
    print(table(rows))
    print(verdict(rows))
    print(f"numbers and picture: {output}")


def configuration(card: Mapping[str, Any], folder: Path) -> DictConfig:
    """The configuration that a reward model was trained with.

    Raises:
        ValueError: if the card does not have it, or if people drove the demonstrations: nobody can
            drive them elsewhere.
    """
    if "config" not in card:
        raise ValueError(f"{folder}: the card has no configuration of recipes.drex.drex.")
    if "demonstrator" not in card:
        raise ValueError(
            f"{folder} was trained with recorded demonstrations, which nobody drives in other scenes: "
            "give a model of the scripted circle; style_contrast.png of the run shows the others."
        )
    return OmegaConf.create(dict(card["config"]))


def scripted(cfg: DictConfig) -> dict[str, TensorDictModuleBase]:
    """The demonstrator, and what it must be told from."""
    radius, speed = cfg.demonstrations.radius, cfg.demonstrations.speed
    drivers: dict[str, TensorDictModuleBase] = {DEMONSTRATOR: demonstrator(cfg)}
    for share in RADII:
        drivers[f"orbit {share * radius:.2f} m"] = demonstrator(cfg, radius=share * radius)
    drivers["mirrored"] = demonstrator(cfg, side=styles.opposite_side(cfg))
    drivers["cut corners"] = styles.detour(cfg, radius)
    drivers["half the speed"] = demonstrator(cfg, speed=speed / 2)
    drivers["straight"] = styles.straight(cfg)
    return drivers


def given(cfg: DictConfig, folders: Sequence[Path]) -> dict[str, TensorDictModuleBase]:
    """Policies at demonstration = 1, by the names of their folders.

    Raises:
        ValueError: for a policy without that objective, or one that senses something else.
    """
    found: dict[str, TensorDictModuleBase] = {}
    for folder in folders:
        policy = load_policy(folder)
        if DEMO not in policy.preference_space.tunable:
            raise ValueError(
                f"--policies {folder}: has the objectives {policy.preference_space.objectives}, "
                f"none of them {DEMO!r}."
            )
        check_policy(policy, cfg.env)
        corner = policy.preference_space.corners()[policy.preference_space.tunable.index(DEMO)]

        def prefer(observation: Tensor, corner: Tensor = corner) -> Tensor:
            return corner.expand(*observation.shape[:-1], -1)

        preference = TensorDictModule(prefer, in_keys=["observation"], out_keys=["preference"])
        name = folder.name if folder.name not in found else str(folder)
        found[name] = TensorDictSequential(preference, policy.actor)
    return found


@torch.no_grad()
def landscape(
    cfg: DictConfig,
    model: RewardModel,
    drivers: Mapping[str, TensorDictModuleBase],
    noises: Sequence[tuple[float, float]],
    *,
    count: int,
    seed: int,
    scale: float = 10.0,
) -> Iterator[Paid]:
    """Drive each driver with each noise in the same scenes.

    Args:
        cfg: that the model was trained with.
        model: the reward model.
        drivers: by name.
        noises: see :class:`Paid`.

    Keyword Args:
        count: scenes, of which those count whose demonstrated way is free of boxes.
        seed: of scenes and noise.
        scale: what a step with R = 0 costs.

    Yields:
        What each gets, noise after noise.
    """
    reference = demonstrated(cfg, count, seed)
    free = reference["free"]
    for noise in noises:
        for name, driver in drivers.items():
            noisy = disturbed(driver, torch.tensor(noise), seed)
            data = rollouts(noisy, count, seed, **cfg.env)
            yield paid(model, data, reference, free, driver=name, noise=noise, scale=scale)


def paid(
    model: RewardModel,
    data: TensorDictBase,
    reference: TensorDictBase,
    free: Tensor,
    *,
    driver: str,
    noise: tuple[float, float],
    scale: float,
) -> Paid:
    """What trajectories ``[N, T]`` get in the scenes ``free`` ``[N]``."""
    score = step_scores(model, data)
    mask = data["mask"] & free.unsqueeze(-1)
    near = mask & (data["human"][..., 0] < NEAR)
    total = (scale * (score - 1) * mask).sum(-1)
    return Paid(
        driver=driver,
        noise=noise,
        episode=total[free].mean().item(),
        near=score[near].mean().item(),
        far=score[mask & ~near].mean().item(),
        frechet=frechet(data, reference)[free].mean().item(),
        success=succeeded(data)[free].float().mean().item(),
    )


def verdict(rows: Sequence[Paid]) -> str:
    """The gates: R of the demonstrator, and whether anything is paid more than it."""
    lines = []
    first = next(row for row in rows if row.driver == DEMONSTRATOR)
    for place, value in (("near the human", first.near), ("away from them", first.far)):
        lines.append(f"R of the demonstrator {place}: {value:.3f} (gate: >= {GATE})")
    for noise in dict.fromkeys(row.noise for row in rows):
        of_noise = [row for row in rows if row.noise == noise]
        demonstration = next(row for row in of_noise if row.driver == DEMONSTRATOR)
        # Who hardly arrives has short episodes, not a better style.
        others = [row for row in of_noise if row.driver != DEMONSTRATOR and row.success >= ARRIVES]
        best = max(others, key=lambda row: row.episode)
        lines.append(
            f"noise {_shown(noise)}: the demonstrator gets {demonstration.episode:.0f}, "
            f"the next, {best.driver}, {best.episode:.0f} (gate: less)"
        )
    return "\n".join(lines)


def table(rows: Sequence[Paid]) -> str:
    """A line for each driver and noise."""
    width = max(len(row.driver) for row in rows)
    heads = ("return", "R near", "R far", "Frechet / m", "success / %")
    lines = [f"{'noise':>12} {'driver':>{width}}" + "".join(f"{head:>13}" for head in heads)]
    for row in rows:
        numbers = (
            f"{row.episode:13.0f}{row.near:13.3f}{row.far:13.3f}{row.frechet:13.2f}"
            f"{100 * row.success:13.0f}"
        )
        lines.append(f"{_shown(row.noise):>12} {row.driver:>{width}}{numbers}")
    return "\n".join(lines)


def write_csv(path: Path, rows: Sequence[Paid]) -> None:
    """One row for each driver and noise."""
    names = [field.name for field in dataclasses.fields(Paid) if field.name != "noise"]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([*names, "noise_speed", "noise_turn"])
        for row in rows:
            writer.writerow([*(getattr(row, name) for name in names), *row.noise])


def figure(path: Path, rows: Sequence[Paid]) -> None:
    """Returns of all drivers, one panel for each noise."""
    noises = list(dict.fromkeys(row.noise for row in rows))
    drivers = list(dict.fromkeys(row.driver for row in rows))
    fig, axes = plt.subplots(
        1,
        len(noises),
        figsize=(3.2 + 2.6 * len(noises), 1.2 + 0.3 * len(drivers)),
        sharey=True,
        layout="constrained",
        squeeze=False,
    )
    for ax, noise in zip(axes[0], noises, strict=True):
        values = [row.episode for row in rows if row.noise == noise]
        best = max(range(len(values)), key=values.__getitem__)
        colors = ["#0072b2" if name == DEMONSTRATOR else "0.7" for name in drivers]
        bars = ax.barh(drivers, values, color=colors)
        bars[best].set_edgecolor("#d55e00")
        bars[best].set_linewidth(2)
        ax.bar_label(bars, fmt="%.0f", fontsize=8, padding=2)
        ax.margins(x=0.2)
        ax.set_title(f"noise {_shown(noise)}", fontsize=10)
        ax.locator_params(axis="x", nbins=4)
        ax.grid(axis="x", alpha=0.3)
    axes[0][0].invert_yaxis()
    fig.supxlabel("return of the demonstrated style; the most is framed", fontsize=10)
    fig.savefig(path, dpi=120)
    plt.close(fig)


def _shown(noise: tuple[float, float]) -> str:
    return f"{noise[0]:g}, {noise[1]:g}"


if __name__ == "__main__":
    main()
