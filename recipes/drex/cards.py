"""What stands in the cards of what D-REX makes."""

from __future__ import annotations

import importlib.metadata
from typing import Any

from omegaconf import DictConfig

from recipes.training.policies import card_config

from .demonstrations import demonstrator_arguments


def metadata(cfg: DictConfig) -> dict[str, Any]:
    """What made the demonstrations."""
    packages = ("torch", "torchrl", "tensordict", "mujoco", "torchrl-morl")
    made = {
        "config": card_config(cfg),
        "versions": {name: importlib.metadata.version(name) for name in packages},
    }
    if cfg.demonstrations.dataset is None:
        # Whoever finds it drives it, to measure how close a policy comes.
        robot = made["config"]["env"]["robot"]
        made["demonstrator"] = demonstrator_arguments(cfg) | {"robot": robot}
    return made
