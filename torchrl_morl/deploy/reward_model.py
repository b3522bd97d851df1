"""Reward models as files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from torchrl_morl.modules import RewardModel

from .files import read_config, read_weights, write_module

__all__ = ["load_reward_model", "save_reward_model"]

_KIND = "reward_model"
_REQUIRED = ("in_features", "in_keys", "num_cells", "num_members")


def save_reward_model(
    folder: str | Path,
    model: RewardModel,
    *,
    in_features: int,
    num_cells: tuple[int, ...],
    num_members: int,
    card: dict[str, Any],
) -> Path:
    """Write a reward model to a folder: ``reward_model.safetensors`` and ``reward_model.json``.

    Args:
        folder: made if missing; must not hold a reward model yet.
        model: with plain string ``in_keys``.

    Keyword Args:
        in_features: summed size of its inputs.
        num_cells: hidden sizes.
        num_members: networks in the ensemble.
        card: whatever a reader should know (data, seeds, diagnostics), as JSON values.

    Returns:
        The folder.

    Raises:
        FileExistsError: if the folder holds a reward model already.
    """
    config = {
        "in_features": in_features,
        "in_keys": list(model.in_keys),
        "num_cells": list(num_cells),
        "num_members": num_members,
        "card": card,
    }
    return write_module(folder, _KIND, model, config)


def load_reward_model(
    folder: str | Path, device: torch.device | str | None = None
) -> tuple[RewardModel, dict[str, Any]]:
    """Read a reward model written by :func:`save_reward_model`.

    Args:
        folder: with ``reward_model.safetensors`` and ``reward_model.json``.
        device: where to put it.

    Returns:
        The frozen model and its card.

    Raises:
        FileNotFoundError: if a file is missing.
        ValueError: if a file is broken, of another format, or does not fit the other.
    """
    config = read_config(folder, _KIND, _REQUIRED)
    try:
        model = RewardModel(
            in_features=config["in_features"],
            in_keys=config["in_keys"],
            num_cells=config["num_cells"],
            num_members=config["num_members"],
        )
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{folder}/{_KIND}.json describes no reward model: {error}") from error
    read_weights(folder, _KIND, model)
    return model.requires_grad_(False).eval().to(device), config.get("card", {})
