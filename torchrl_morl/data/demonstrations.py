"""Demonstrations as a file: padded trajectories in safetensors, with what made them."""

from __future__ import annotations

import json
import uuid
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_morl.deploy.entries import null_for_nan, one_line, parse_json

__all__ = ["load_demonstrations", "save_demonstrations"]

_FORMAT = "torchrl_morl.demonstrations/1"
_MAX_DEPTH = 32

_DTYPES = {
    "BOOL": torch.bool,
    "U8": torch.uint8,
    "I32": torch.int32,
    "I64": torch.int64,
    "F32": torch.float32,
    "F64": torch.float64,
}
"""What a leaf may be, in the words of safetensors and of PyTorch."""


def save_demonstrations(
    path: str | Path, trajectories: TensorDictBase, metadata: dict[str, Any]
) -> Path:
    """Write trajectories to a ``.safetensors`` file.

    Args:
        path: the file, which must not exist; folders are made.
        trajectories: ``[N, T]``, padded, with ``mask`` ``[N, T]`` marking the steps of each
            trajectory. Every leaf is kept, nested keys included.
        metadata: what made them (environment, robot, seed, versions), as JSON values. NaN and
            infinity, which JSON does not know, become null.

    Returns:
        The path. The file appears whole or not at all.

    Raises:
        FileExistsError: if the file exists.
        ValueError: if there is no boolean ``mask`` of the batch's shape, no step, or a leaf that could
            not be read again.

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
    if not mask.numel():
        raise ValueError(f"trajectories of shape {list(mask.shape)} have no step to save.")
    for key in trajectories.keys(True, True):
        parts = (key,) if isinstance(key, str) else key
        if any("/" in part or not part for part in parts):
            raise ValueError(f"the key {key!r} has a '/' or is empty: it cannot be saved.")
        value = trajectories.get(key)
        if not isinstance(value, Tensor) or value.dtype not in _DTYPES.values():
            kind = value.dtype if isinstance(value, Tensor) else type(value).__name__
            names = ", ".join(str(dtype).removeprefix("torch.") for dtype in _DTYPES.values())
            raise ValueError(f"{key!r} is {kind} and cannot be saved: convert it to {names}.")
    # Copies: the file format refuses tensors that share memory, as done and terminated may.
    tensors = {
        name: value.cpu().clone(memory_format=torch.contiguous_format)
        for name, value in trajectories.flatten_keys("/").items()
    }
    text = json.dumps(null_for_nan(metadata), allow_nan=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{uuid.uuid4().hex[:12]}")
    try:
        save_file(tensors, partial, {"format": _FORMAT, "metadata": text})
        partial.rename(path)
    finally:
        partial.unlink(missing_ok=True)
    return path


def load_demonstrations(path: str | Path) -> tuple[TensorDict, dict[str, Any]]:
    """Read what :func:`save_demonstrations` wrote.

    Args:
        path: the file.

    Returns:
        The trajectories ``[N, T]`` and the metadata.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is not a demonstrations file of this format. In one line, before any tensor
            has been read.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path} not found: demonstrations are a .safetensors file.")
    try:
        with safe_open(path, "pt") as file:
            header = file.metadata() or {}
            if header.get("format") != _FORMAT:
                found = repr(header.get("format"))[:80]
                raise ValueError(f"{path} has format {found}, expected {_FORMAT!r}.")
            parts = {name: file.get_slice(name) for name in file.keys()}
            shapes = {name: tuple(part.get_shape()) for name, part in parts.items()}
            dtypes = {name: part.get_dtype() for name, part in parts.items()}
            _check_header(path, shapes, dtypes)
            metadata = parse_json(header.get("metadata", ""), f"the metadata of {path}")
            if not isinstance(metadata, dict):
                raise ValueError(f"the metadata of {path} are no JSON object.")
            tensors = {name: file.get_tensor(name) for name in shapes}
    except SafetensorError as error:
        raise ValueError(f"{path} is not a safetensors file: {one_line(error)}.") from error
    for name, value in tensors.items():
        if value.dtype == torch.bool and value.view(torch.uint8).max() > 1:
            raise ValueError(f"{path}: {name[:80]!r} holds values that are neither true nor false.")
    data = TensorDict(tensors, batch_size=tensors["mask"].shape).unflatten_keys("/")
    return data, metadata


def _check_header(path: Path, shapes: dict[str, tuple[int, ...]], dtypes: dict[str, str]) -> None:
    """Refuse tensors that do not belong together."""
    if dtypes.get("mask") != "BOOL" or not shapes["mask"]:
        raise ValueError(
            f"{path} has no boolean 'mask': it was not written by save_demonstrations."
        )
    batch = shapes["mask"]
    for name, shape in shapes.items():
        if dtypes[name] not in _DTYPES:
            raise ValueError(
                f"{path}: {name[:80]!r} is {dtypes[name]}, not one of {list(_DTYPES)}."
            )
        if shape[: len(batch)] != batch or 0 in shape:
            raise ValueError(
                f"{path}: {name[:80]!r} has shape {list(shape)}, which does not begin with that of "
                f"the mask, {list(batch)}, or holds nothing."
            )
        parts = name.split("/", _MAX_DEPTH)
        parents = {"/".join(parts[:end]) for end in range(1, len(parts))}
        if (
            not all(parts)
            or len(parts) > _MAX_DEPTH
            or parents & shapes.keys()
            or not name.isprintable()
        ):
            raise ValueError(f"{path}: {name[:80]!r} is no key of a tensordict.")
