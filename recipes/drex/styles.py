"""Other ways to drive: what ranks below the demonstrations, and what they must be told from."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from envs.demonstrator import DetourDriver, StraightDriver
from torchrl_morl.modules import RewardModel

from .utils import demonstrator, demonstrator_arguments, rollouts

_NUM_STYLES = 6


def rollouts_per_style(cfg: DictConfig) -> int:
    """The share of each of the other styles; 0 is plain D-REX, without them.

    Raises:
        ValueError: if a style has no rollout to train on beside the one that is held out.
    """
    total = cfg.style_negatives.rollouts
    if total != 0 and total < 2 * _NUM_STYLES:
        raise ValueError(
            f"style_negatives.rollouts must be 0 or at least {2 * _NUM_STYLES}, one to train on and "
            f"one to hold out for each of {_NUM_STYLES} styles, got {total}."
        )
    return total // _NUM_STYLES


def other_styles(cfg: DictConfig) -> list[TensorDictBase]:
    """Orbits at other radii, mirrored orbits, detours and straight driving, in random scenes."""
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
    return [
        rollouts(policy, count, cfg.seed + 20_000 + index, **cfg.env)
        for index, policy in enumerate(policies)
    ]


def contrast_styles(cfg: DictConfig) -> dict[str, TensorDictModuleBase]:
    """The demonstration and what it must be told from."""
    styles: dict[str, TensorDictModuleBase] = {"demonstration": demonstrator(cfg)}
    for factor in (0.7, 1.3, 1.6):
        other = factor * cfg.demonstrations.radius
        styles[f"orbit {other:.1f} m"] = demonstrator(cfg, radius=other)
    styles["mirrored"] = demonstrator(cfg, side=opposite_side(cfg))
    styles["cut corners"] = detour(cfg, cfg.demonstrations.radius)
    styles["distance keeping"] = detour(cfg, 1.9)
    styles["straight"] = straight(cfg)
    return styles


@torch.no_grad()
def style_contrast(cfg: DictConfig, model: RewardModel, within: float = 2.0) -> dict[str, float]:
    """Mean R of each style over its steps within 2 m of the human, on fresh scenes."""
    result = {}
    for name, policy in contrast_styles(cfg).items():
        data = rollouts(policy, cfg.diagnostics.rollouts, cfg.seed + 30_000, **cfg.env)
        score = model(data.select("observation", "action"))["demo_score"].squeeze(-1)
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
