"""Demonstrations as a file: padded trajectories in safetensors, with what made them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from tensordict import TensorDict, TensorDictBase

__all__ = ["load_demonstrations", "save_demonstrations"]

_FORMAT = "torchrl_morl.demonstrations/1"


def save_demonstrations(
    path: str | Path, trajectories: TensorDictBase, metadata: dict[str, Any]
) -> Path:
    """Write trajectories to a ``.safetensors`` file.

    Args:
        path: the file, which must not exist; folders are made.
        trajectories: ``[N, T]``, padded, with ``mask`` ``[N, T]`` marking the steps of each
            trajectory. Every leaf is kept, nested keys included.
        metadata: what made them (environment, robot, seed, versions), as JSON values.

    Returns:
        The path.

    Raises:
        FileExistsError: if the file exists.
        ValueError: if there is no boolean ``mask`` of the batch's shape.

    Example:
        >>> import tempfile, torch
        >>> from tensordict import TensorDict
        >>> data = TensorDict(
        ...     observation=torch.rand(2, 5, 3),
        ...     mask=torch.ones(2, 5, dtype=torch.bool),
        ...     batch_size=[2, 5],
        ... )
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = save_demonstrations(f"{folder}/demos.safetensors", data, {"seed": 0})
        ...     loaded, metadata = load_demonstrations(path)
        >>> bool((loaded == data).all()), metadata
        (True, {'seed': 0})
    """
    path = Path(path)
    if path.exists():
        raise FileExistsError(f"{path} exists and is not overwritten: choose another name.")
    mask = trajectories.get("mask", None)
    if mask is None or mask.dtype != torch.bool or mask.shape != trajectories.batch_size:
        raise ValueError(
            f"trajectories need a boolean 'mask' of shape {list(trajectories.batch_size)}."
        )
    flat = trajectories.flatten_keys("/")
    # Copies: the file format refuses tensors that share memory, as done and terminated may.
    tensors = {
        name: value.cpu().clone(memory_format=torch.contiguous_format)
        for name, value in flat.items()
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    save_file(tensors, path, {"format": _FORMAT, "metadata": json.dumps(metadata)})
    return path


def load_demonstrations(path: str | Path) -> tuple[TensorDict, dict[str, Any]]:
    """Read what :func:`save_demonstrations` wrote.

    Args:
        path: the file.

    Returns:
        The trajectories ``[N, T]`` and the metadata.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is not a demonstrations file of this format.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path} not found: demonstrations are a .safetensors file.")
    try:
        with safe_open(path, "pt") as file:
            header = file.metadata() or {}
            if header.get("format") != _FORMAT:
                raise ValueError(
                    f"{path} has format {header.get('format')!r}, expected {_FORMAT!r}."
                )
            tensors = {name: file.get_tensor(name) for name in file.keys()}
    except SafetensorError as error:
        raise ValueError(f"{path} is not a safetensors file: {error}.") from error
    if "mask" not in tensors:
        raise ValueError(f"{path} has no 'mask': it was not written by save_demonstrations.")
    data = TensorDict(tensors, batch_size=tensors["mask"].shape).unflatten_keys("/")
    return data, json.loads(header["metadata"])
