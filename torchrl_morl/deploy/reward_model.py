"""Reward models as files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from torchrl_morl.arguments import check_device
from torchrl_morl.modules import RewardModel

from .entries import Entries, named
from .files import count_tensors, paths, read_config, read_weights, write_module
from .networks import (
    ACTIVATIONS,
    check_restorable,
    describe_mlp,
    keys_from_json,
    keys_to_json,
)

__all__ = ["load_reward_model", "save_reward_model"]

_KIND = "reward_model"


def save_reward_model(folder: str | Path, model: RewardModel, *, card: Mapping[str, Any]) -> Path:
    """Write a reward model to a folder: ``reward_model.safetensors`` and ``reward_model.json``.

    Sizes, keys, activation and dtype are read from the model. What could not be restored is refused.

    Args:
        folder: must not exist, or be empty; it appears whole or not at all.
        model: to save.

    Keyword Args:
        card: whatever a reader should know (data, seeds, diagnostics), as JSON values.

    Returns:
        The folder.

    Raises:
        FileExistsError: if the folder holds something already.
        ValueError: for a model that the files could not restore.
    """
    members = [describe_mlp(member) for member in model.module.members]
    if any(member != members[0] for member in members):
        raise ValueError("the members of the reward model differ: it cannot be restored.")
    network = {
        **members[0],
        "num_members": len(members),
        "in_keys": keys_to_json(model.in_keys),
        "out_key": keys_to_json(model.out_keys)[0],
    }
    check_restorable(model, _build(Entries(network, _KIND)))
    return write_module(folder, _KIND, model, {"network": network, "card": dict(card)})


def load_reward_model(
    folder: str | Path, device: torch.device | str | None = None
) -> tuple[RewardModel, dict[str, Any]]:
    """Read a reward model written by :func:`save_reward_model`.

    Args:
        folder: with ``reward_model.safetensors`` and ``reward_model.json``, also of earlier versions.
        device: where to put it.

    Returns:
        The frozen model and its card.

    Raises:
        FileNotFoundError: if a file is missing.
        ValueError: if a file is broken, changed, of another format, or does not fit the other. In one
            line.
    """
    check_device("device", device)
    config = read_config(folder, _KIND)
    if config["format"] > 1:
        network = config.object("network")
    else:
        defaults = {"activation": "ReLU", "out_key": "demo_score"}
        network = Entries({**config, **defaults}, config.where)
    depth, num_members = len(network.integers("num_cells")), network.integer("num_members")
    if count_tensors(folder, _KIND) != 2 * (depth + 1) * num_members:
        raise ValueError(
            f"{paths(folder, _KIND)[0]} does not fit {_KIND}.json: it should have "
            f"{2 * (depth + 1) * num_members} entries, for {num_members} members with {depth} hidden "
            "layers, and has another number."
        )
    card = config.plain("card")
    with named(network.where):
        model = _build(network)
    read_weights(folder, _KIND, model, config)
    return model.requires_grad_(False).eval().to(device), card


def _build(network: Entries) -> RewardModel:
    """The model of a description, without weights."""
    out_key = Entries({"out_key": [network["out_key"]]}, network.where)
    return RewardModel(
        in_features=network.integer("in_features"),
        in_keys=keys_from_json(network, "in_keys"),
        num_cells=network.integers("num_cells"),
        activation_class=ACTIVATIONS[network.choice("activation", tuple(ACTIVATIONS))],
        out_key=keys_from_json(out_key, "out_key")[0],
        num_members=network.integer("num_members"),
        device="meta",
    )
