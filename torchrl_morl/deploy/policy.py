"""Policies as files: weights in safetensors, everything else in JSON beside them.

Neither format can run code when it is opened.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from torchrl.data import Bounded

from torchrl_morl.modules import make_actor
from torchrl_morl.preferences import PreferenceSpace
from torchrl_morl.transforms import check_finite

__all__ = ["load_policy", "save_policy"]

_FORMAT = 1
_WEIGHTS, _CONFIG = "policy.safetensors", "policy.json"
_REQUIRED = ("format", "objectives", "static", "observation_size", "action_size", "num_cells")


def save_policy(
    folder: str | Path,
    actor: TensorDictSequential,
    *,
    space: PreferenceSpace,
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
        space: what the entries of the preference mean.
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
    folder = Path(folder)
    for name in (_WEIGHTS, _CONFIG):
        if (folder / name).exists():
            raise FileExistsError(
                f"{folder / name} exists and is not overwritten: remove it or choose another folder."
            )
    config = {
        "format": _FORMAT,
        "objectives": list(space.objectives),
        "static": dict(space.static),
        "observation_size": observation_size,
        "action_size": action_size,
        "num_cells": list(num_cells),
        "card": _null_for_nan(card),
    }
    text = json.dumps(config, indent=2, allow_nan=False) + "\n"
    folder.mkdir(parents=True, exist_ok=True)
    weights = {name: value.contiguous().cpu() for name, value in actor.state_dict().items()}
    save_file(weights, folder / _WEIGHTS)
    (folder / _CONFIG).write_text(text)
    return folder


def _null_for_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _null_for_nan(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_null_for_nan(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


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
    folder = Path(folder)
    for name in (_WEIGHTS, _CONFIG):
        if not (folder / name).is_file():
            raise FileNotFoundError(
                f"{folder / name} not found: a policy is a folder with {_WEIGHTS} and {_CONFIG}."
            )
    try:
        config = json.loads((folder / _CONFIG).read_text())
    except ValueError as error:
        raise ValueError(f"{folder / _CONFIG} is not valid JSON: {error}.") from error
    if not isinstance(config, dict):
        raise ValueError(f"{folder / _CONFIG} is not a policy: no JSON object.")
    missing = [key for key in _REQUIRED if key not in config]
    if missing:
        raise ValueError(f"{folder / _CONFIG} is not a policy: {', '.join(missing)} missing.")
    if config["format"] != _FORMAT:
        raise ValueError(
            f"{folder / _CONFIG} has format {config['format']}, this version reads {_FORMAT}: "
            "use the torchrl-morl version that wrote it."
        )
    try:
        space = PreferenceSpace(tuple(config["objectives"]), static=config["static"])
        actor = make_actor(
            Bounded(-1.0, 1.0, shape=(config["action_size"],)),
            in_features=config["observation_size"] + space.num_tunable,
            num_cells=tuple(config["num_cells"]),
        )
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{folder / _CONFIG} describes no policy: {error}") from error
    try:
        weights = load_file(folder / _WEIGHTS)
    except SafetensorError as error:
        raise ValueError(f"{folder / _WEIGHTS} is not a safetensors file: {error}.") from error
    expected = {name: tuple(value.shape) for name, value in actor.state_dict().items()}
    found = {name: tuple(value.shape) for name, value in weights.items()}
    if expected != found:
        different = sorted(
            name for name in expected.keys() | found.keys() if expected.get(name) != found.get(name)
        )
        name = different[0]
        raise ValueError(
            f"{folder / _WEIGHTS} does not fit {_CONFIG}: {name} should have shape "
            f"{expected.get(name, 'none')} and has {found.get(name, 'none')} "
            f"({len(different)} entries differ)."
        )
    try:
        check_finite(weights, list(weights))
    except ValueError as error:
        raise ValueError(f"{folder / _WEIGHTS} is of no use: {error}") from error
    actor.load_state_dict(weights)
    actor.requires_grad_(False).eval().to(device)
    # A hook and not a module, so that the state dict stays the one of `make_actor`.
    actor.register_forward_pre_hook(_check_inputs, with_kwargs=True)
    return actor, space, config.get("card", {})


def _check_inputs(actor: TensorDictSequential, args: tuple, kwargs: dict[str, Any]) -> None:
    """Check the inputs of an actor, given as a tensordict or one by one."""
    data = kwargs.get("tensordict", args[0] if args else None)
    if not isinstance(data, TensorDictBase):
        data = dict(zip(actor.in_keys, args)) | kwargs
    check_finite(data, actor.in_keys)
