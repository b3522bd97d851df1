"""Policies as files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from torchrl.data import Bounded

from torchrl_morl.modules import make_actor
from torchrl_morl.preferences import PreferenceSpace
from torchrl_morl.transforms import check_finite

from .files import read_config, read_weights, write_module

__all__ = ["load_policy", "save_policy"]

_KIND = "policy"
_REQUIRED = ("objectives", "static", "observation_size", "action_size", "num_cells")


def save_policy(
    folder: str | Path,
    actor: TensorDictSequential,
    *,
    preference_space: PreferenceSpace,
    observation_size: int,
    action_size: int,
    num_cells: tuple[int, ...],
    card: dict[str, Any],
) -> Path:
    """Write an actor made by :func:`~torchrl_morl.modules.make_actor` to a folder.

    Args:
        folder: made if missing; must not hold a policy yet.
        actor: reads ``observation`` and ``preference``, writes ``action`` in [-1, 1].

    Keyword Args:
        preference_space: what the entries of the preference mean.
        observation_size: entries of the observation.
        action_size: entries of the action.
        num_cells: hidden sizes.
        card: whatever a reader should know (environment, training configuration, versions,
            results), as JSON values. NaN and infinity, which JSON does not know, become null.

    Returns:
        The folder.

    Raises:
        FileExistsError: if the folder holds a policy already.
    """
    config = {
        "objectives": list(preference_space.objectives),
        "static": dict(preference_space.static),
        "observation_size": observation_size,
        "action_size": action_size,
        "num_cells": list(num_cells),
        "card": card,
    }
    return write_module(folder, _KIND, actor, config)


def load_policy(
    folder: str | Path, device: torch.device | str | None = None
) -> tuple[TensorDictSequential, PreferenceSpace, dict[str, Any]]:
    """Read a policy written by :func:`save_policy`.

    Args:
        folder: with ``policy.safetensors`` and ``policy.json``.
        device: where to put the actor.

    Returns:
        The actor (in evaluation mode, without gradients), its preference space and its card. Fed
        with an input that is NaN or infinite, the actor raises ``ValueError``.

    Raises:
        FileNotFoundError: if a file is missing.
        ValueError: if a file is not what it should be: broken, of another format, or with weights
            that are not finite or do not fit the configuration.
    """
    config = read_config(folder, _KIND, _REQUIRED)
    try:
        preference_space = PreferenceSpace(tuple(config["objectives"]), static=config["static"])
        actor = make_actor(
            Bounded(-1.0, 1.0, shape=(config["action_size"],)),
            in_features=config["observation_size"] + preference_space.num_tunable,
            num_cells=tuple(config["num_cells"]),
        )
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{folder}/{_KIND}.json describes no policy: {error}") from error
    read_weights(folder, _KIND, actor)
    actor.requires_grad_(False).eval().to(device)
    # A hook and not a module, so that the state dict stays the one of `make_actor`.
    actor.register_forward_pre_hook(_check_inputs, with_kwargs=True)
    return actor, preference_space, config.get("card", {})


def _check_inputs(actor: TensorDictSequential, args: tuple, kwargs: dict[str, Any]) -> None:
    """Check the inputs of an actor, given as a tensordict or one by one."""
    data = kwargs.get("tensordict", args[0] if args else None)
    if not isinstance(data, TensorDictBase):
        data = dict(zip(actor.in_keys, args)) | kwargs
    check_finite(data, actor.in_keys)
