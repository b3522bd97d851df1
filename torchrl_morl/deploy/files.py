"""Modules as folders: weights in safetensors, everything else in JSON beside them.

Neither format can run code when it is opened.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import nn

from torchrl_morl.transforms import check_finite

FORMAT = 1


def write_module(folder: str | Path, kind: str, module: nn.Module, config: dict[str, Any]) -> Path:
    """Write ``{kind}.safetensors`` and ``{kind}.json``.

    Raises:
        FileExistsError: if one of them exists.
    """
    folder = Path(folder)
    weights_file, config_file = _paths(folder, kind)
    for path in (weights_file, config_file):
        if path.exists():
            raise FileExistsError(
                f"{path} exists and is not overwritten: remove it or choose another folder."
            )
    config = _null_for_nan({"format": FORMAT, **config})
    text = json.dumps(config, indent=2, allow_nan=False) + "\n"
    folder.mkdir(parents=True, exist_ok=True)
    weights = {name: value.contiguous().cpu() for name, value in module.state_dict().items()}
    save_file(weights, weights_file)
    config_file.write_text(text)
    return folder


def read_config(folder: str | Path, kind: str, required: Sequence[str]) -> dict[str, Any]:
    """Read ``{kind}.json`` and check that it is of this format and complete.

    Raises:
        FileNotFoundError: if it, or the weights beside it, are missing.
        ValueError: if it is not what it should be.
    """
    weights_file, config_file = _paths(folder, kind)
    for path in (weights_file, config_file):
        if not path.is_file():
            raise FileNotFoundError(
                f"{path} not found: a {kind.replace('_', ' ')} is a folder with "
                f"{weights_file.name} and {config_file.name}."
            )
    try:
        config = json.loads(config_file.read_text())
    except ValueError as error:
        raise ValueError(f"{config_file} is not valid JSON: {error}.") from error
    if not isinstance(config, dict):
        raise ValueError(f"{config_file} is not a {kind}: no JSON object.")
    missing = [key for key in ("format", *required) if key not in config]
    if missing:
        raise ValueError(f"{config_file} is not a {kind}: {', '.join(missing)} missing.")
    if config["format"] != FORMAT:
        raise ValueError(
            f"{config_file} has format {config['format']}, this version reads {FORMAT}: "
            "use the torchrl-morl version that wrote it."
        )
    return config


def read_weights(folder: str | Path, kind: str, module: nn.Module) -> None:
    """Read ``{kind}.safetensors`` into a module.

    Raises:
        ValueError: if the file is broken, does not fit the module or holds values that are not
            finite.
    """
    weights_file, config_file = _paths(folder, kind)
    try:
        weights = load_file(weights_file)
    except SafetensorError as error:
        raise ValueError(f"{weights_file} is not a safetensors file: {error}.") from error
    expected = {name: tuple(value.shape) for name, value in module.state_dict().items()}
    found = {name: tuple(value.shape) for name, value in weights.items()}
    if expected != found:
        different = sorted(
            name for name in expected.keys() | found.keys() if expected.get(name) != found.get(name)
        )
        name = different[0]
        raise ValueError(
            f"{weights_file} does not fit {config_file.name}: {name} should have shape "
            f"{expected.get(name, 'none')} and has {found.get(name, 'none')} "
            f"({len(different)} entries differ)."
        )
    try:
        check_finite(weights, list(weights))
    except ValueError as error:
        raise ValueError(f"{weights_file} is of no use: {error}") from error
    module.load_state_dict(weights)


def _paths(folder: str | Path, kind: str) -> tuple[Path, Path]:
    return Path(folder) / f"{kind}.safetensors", Path(folder) / f"{kind}.json"


def _null_for_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _null_for_nan(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_null_for_nan(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
