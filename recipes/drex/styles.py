"""Other ways to drive: what ranks below the demonstrations, and what they must be told from."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torch import Tensor

from envs.demonstrations import DetourDriver, Driver, StraightDriver
from torchrl_morl.modules import RewardModel

from .demonstrations import demonstrator, demonstrator_arguments
from .ranking import step_scores
from .recorded import distance_from_recorded
from .rollouts import rollouts

NUM_STYLES = 6
"""How many other ways to drive there are: see :func:`other_styles`."""


def rollouts_per_style(cfg: DictConfig) -> int:
    """The share of each of the other styles; 0 is plain D-REX, without them.

    Raises:
        ValueError: if a style has no rollout to train on beside the one that is held out.
    """
    total = cfg.style_negatives.rollouts
    if total != 0 and total < 2 * NUM_STYLES:
        raise ValueError(
            f"style_negatives.rollouts must be 0 or at least {2 * NUM_STYLES}, one to train on and "
            f"one to hold out for each of {NUM_STYLES} styles, got {total}."
        )
    return total // NUM_STYLES


def other_styles(cfg: DictConfig, recorded: TensorDictBase | None = None) -> list[TensorDictBase]:
    """Orbits at other radii, mirrored orbits, detours and straight driving, in random scenes.

    Beside ``recorded`` demonstrations ``[N, T]``, whose style may be any of these, those are left out
    that come close to them; a style is, if fewer than two of its rollouts remain.
    """
    section = cfg.style_negatives
    count = rollouts_per_style(cfg)
    generator = torch.Generator().manual_seed(cfg.seed)

    def radii(pairs: Sequence[Sequence[float]]) -> Tensor:
        ranges = torch.tensor([list(pair) for pair in pairs])
        pick = ranges[torch.randint(len(ranges), (count,), generator=generator)]
        return pick[:, 0] + (pick[:, 1] - pick[:, 0]) * torch.rand(count, generator=generator)

    mirror = opposite_side(cfg)
    policies = (
        demonstrator(cfg, radius=radii(section.radii)),
        demonstrator(cfg, radius=radii(section.radii), side=mirror),
        demonstrator(cfg, side=mirror),
        detour(cfg, radii([section.detours])),
        detour(cfg, radii([section.detours]), side=mirror),
        straight(cfg),
    )
    groups = []
    for index, policy in enumerate(policies):
        data = rollouts(policy, count, cfg.seed + 20_000 + index, **cfg.env)
        if recorded is not None:
            distance = distance_from_recorded(cfg, policy, recorded, count)
            data = data[distance >= section.min_frechet]
        if len(data) > 1:
            groups.append(data)
    return groups


def contrast_styles(cfg: DictConfig) -> dict[str, Driver]:
    """The demonstration and what it must be told from."""
    styles: dict[str, Driver] = {"demonstration": demonstrator(cfg)}
    for factor in (0.7, 1.3, 1.6):
        other = factor * cfg.demonstrations.radius
        styles[f"orbit {other:.1f} m"] = demonstrator(cfg, radius=other)
    styles["mirrored"] = demonstrator(cfg, side=opposite_side(cfg))
    styles["cut corners"] = detour(cfg, cfg.demonstrations.radius)
    styles["distance keeping"] = detour(cfg, 1.9)
    styles["straight"] = straight(cfg)
    return styles


def rivals_of_recorded(cfg: DictConfig, recorded: TensorDictBase) -> dict[str, Driver]:
    """What recorded demonstrations must be told from: of all styles, those that they are not."""
    styles = contrast_styles(cfg)
    styles[f"orbit {cfg.demonstrations.radius:.1f} m"] = styles.pop("demonstration")
    count, least = cfg.diagnostics.rollouts, cfg.style_negatives.min_frechet
    return {
        name: driver
        for name, driver in styles.items()
        if distance_from_recorded(cfg, driver, recorded, count).mean() >= least
    }


@torch.no_grad()
def style_contrast(
    cfg: DictConfig,
    model: RewardModel,
    recorded: TensorDictBase | None = None,
    within: float = 2.0,
) -> dict[str, float]:
    """Mean R of each style over its steps within 2 m of the human.

    On fresh scenes, but for ``recorded`` demonstrations, which have only those that R has learned from.
    """
    if recorded is None:
        drives = {}
        drivers = contrast_styles(cfg)
    else:
        drives = {"demonstration": recorded}
        drivers = rivals_of_recorded(cfg, recorded)
    for name, policy in drivers.items():
        drives[name] = rollouts(policy, cfg.diagnostics.rollouts, cfg.seed + 30_000, **cfg.env)
    result = {}
    for name, data in drives.items():
        score = step_scores(model, data)
        near = data["mask"] & (data["human"][..., 0] < within)
        result[name] = score[near].mean().item()
    return result


def opposite_side(cfg: DictConfig) -> str:
    """Where the demonstration does not pass."""
    return "right" if cfg.demonstrations.side == "left" else "left"


def detour(cfg: DictConfig, radius: float | Tensor, **changes: Any) -> DetourDriver:
    """Passes on the demonstrated side, at a radius, by the shortest way."""
    arguments = demonstrator_arguments(cfg) | {"radius": radius} | changes
    return DetourDriver(**arguments, scaled=True)


def straight(cfg: DictConfig) -> StraightDriver:
    """Drives at the demonstrated speed, whatever stands in the way."""
    return StraightDriver(cfg.demonstrations.speed, cfg.env.robot, scaled=True)
