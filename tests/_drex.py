"""Configurations of the D-REX recipe for its tests, down to a size that takes seconds."""

from __future__ import annotations

from pathlib import Path

from omegaconf import DictConfig, OmegaConf

ROOT = Path(__file__).resolve().parent.parent
TINY = (
    "demonstrations.count=6",
    "demonstrations.batch=12",
    "cloning.updates=100",
    "cloning.batch_size=64",
    "cloning.num_cells=[16]",
    "noise.levels=[0.0,0.2]",
    "noise.rollouts=4",
    "style_negatives.rollouts=24",
    "tracking.rollouts=4",
    "reward_model.updates=20",
    "reward_model.num_cells=[16]",
    "reward_model.batch_size=8",
    "diagnostics.rollouts=4",
    "env.num_threads=1",
)


def config(recipe: str = "drex", overrides: tuple[str, ...] = (), **changes: object) -> DictConfig:
    """Of a recipe, with fields changed: ``style_negatives__rollouts=0``."""
    cfg = OmegaConf.load(ROOT / "recipes" / recipe / "config.yaml")
    del cfg.hydra, cfg.defaults
    cfg = OmegaConf.merge(cfg, OmegaConf.from_dotlist(list(overrides)))
    for key, value in changes.items():
        OmegaConf.update(cfg, key.replace("__", "."), value)
    return cfg
