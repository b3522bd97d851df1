"""Modules as folders: weights in safetensors, everything else in JSON beside them.

Neither format can run code when it is opened. A folder appears whole or not at all. A file is taken
for hostile until it has been read: sizes are compared before anything is allocated.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import reprlib
import shutil
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save
from torch import nn

from torchrl_morl.transforms import check_finite

from .entries import Entries, null_for_nan, one_line, parse_json

FORMAT = 2
"""What is written; format 1, which has neither checksum nor activation, is read as well."""

DTYPES = {"F32": "float32", "F64": "float64"}
"""What weights may be, in the words of safetensors and of PyTorch."""

_MAX_CONFIG_BYTES = 16 * 2**20


@contextlib.contextmanager
def whole_folder(folder: str | Path) -> Iterator[Path]:
    """A folder to write into, which takes its name only when all is written.

    It lies beside its place until then, with a name that starts with a dot; only a process that is
    killed leaves it behind.

    Args:
        folder: must not exist, or be empty.

    Raises:
        FileExistsError: if there is something already.
    """
    final = Path(folder).resolve()
    taken = f"{folder} exists and is not overwritten: remove it or choose another folder."
    if final.exists() and not (final.is_dir() and not any(final.iterdir())):
        raise FileExistsError(taken)
    partial = final.with_name(f".{final.name}.{uuid.uuid4().hex[:12]}")
    partial.mkdir(parents=True)
    try:
        yield partial
        try:
            partial.rename(final)
        except OSError as error:
            if final.exists():  # another process was faster
                raise FileExistsError(taken) from error
            raise
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def weights_bytes(module: nn.Module) -> tuple[bytes, str]:
    """The safetensors file of a module's weights, and their dtype. The same weights are the same bytes.

    Raises:
        ValueError: for weights that could not be read again, see :func:`write_module`.
    """
    weights = {
        name: value.detach().cpu().clone(memory_format=torch.contiguous_format)
        for name, value in module.state_dict().items()
    }
    dtypes = sorted({str(value.dtype).removeprefix("torch.") for value in weights.values()})
    if len(dtypes) != 1 or dtypes[0] not in DTYPES.values():
        raise ValueError(
            f"weights must be all float32 or all float64, got {', '.join(dtypes)}: convert them "
            "with .float() before saving."
        )
    check_finite(weights, list(weights))
    return save(weights), dtypes[0]


def write_module(folder: str | Path, kind: str, module: nn.Module, config: dict[str, Any]) -> Path:
    """Write ``{kind}.safetensors`` and ``{kind}.json``.

    Raises:
        FileExistsError: if the folder exists and is not empty.
        ValueError: for weights that could not be read again: of another dtype than float32 and
            float64, of several, or not finite.
    """
    data, dtype = weights_bytes(module)
    checksum = hashlib.sha256(data).hexdigest()
    config = {"format": FORMAT, "checksum": checksum, "dtype": dtype, **config}
    text = json.dumps(null_for_nan(config), indent=2, allow_nan=False) + "\n"
    with whole_folder(folder) as partial:
        weights_file, config_file = paths(partial, kind)
        write_new(weights_file, data)
        write_new(config_file, text.encode())
    return Path(folder)


def read_config(folder: str | Path, kind: str) -> Entries:
    """Read ``{kind}.json`` and check that it is of a format that can be read.

    Raises:
        FileNotFoundError: if it, or the weights beside it, are missing.
        ValueError: if it is not what it should be.
    """
    weights_file, config_file = paths(folder, kind)
    for path in (weights_file, config_file):
        if not path.is_file():
            raise FileNotFoundError(
                f"{path} not found: a {kind.replace('_', ' ')} is a folder with "
                f"{weights_file.name} and {config_file.name}."
            )
    if config_file.stat().st_size > _MAX_CONFIG_BYTES:
        raise ValueError(f"{config_file} is larger than {_MAX_CONFIG_BYTES >> 20} MiB.")
    config = parse_json(config_file.read_bytes(), str(config_file))
    if not isinstance(config, dict):
        raise ValueError(f"{config_file} is not a {kind}: no JSON object.")
    entries = Entries(config, str(config_file))
    version = entries.get("format")
    if type(version) is not int or not 1 <= version <= FORMAT:
        raise ValueError(
            f"{config_file} has format {reprlib.repr(version)}, this version reads 1 to {FORMAT}: "
            "use the torchrl-morl version that wrote it."
        )
    return entries


def read_weights(folder: str | Path, kind: str, module: nn.Module, config: Entries) -> None:
    """Read ``{kind}.safetensors`` into a module on the ``meta`` device, which gets them as they are.

    Names, sizes and types are compared before a weight is read.

    Raises:
        ValueError: if the file is broken, was changed after it had been written, does not fit the
            module or holds values that are not finite.
    """
    weights_file, config_file = paths(folder, kind)
    dtype = config.choice("dtype", tuple(DTYPES.values())) if config["format"] > 1 else "float32"
    found = read_header(weights_file)
    expected = {name: (dtype, tuple(value.shape)) for name, value in module.state_dict().items()}
    if expected != found:
        names = sorted(expected.keys() | found.keys())
        different = [name for name in names if expected.get(name) != found.get(name)]
        name = different[0]
        raise ValueError(
            f"{weights_file} does not fit {config_file.name}: {reprlib.repr(name)} should be "
            f"{_entry(expected.get(name))} and is {_entry(found.get(name))} "
            f"({len(different)} entries differ)."
        )
    if config["format"] > 1:
        checksum = config.text("checksum")
        if checksum != file_checksum(weights_file):
            raise ValueError(
                f"{weights_file} is not the file that {config_file.name} was written with: its "
                "SHA-256 differs from the checksum. Copy the folder again."
            )
    weights = load_file(weights_file)
    try:
        check_finite(weights, list(weights))
    except ValueError as error:
        raise ValueError(f"{weights_file} is of no use: {error}") from error
    module.load_state_dict(weights, assign=True)


def read_header(path: Path) -> dict[str, tuple[str, tuple[int, ...]]]:
    """Dtype and shape of every tensor of a safetensors file; its values are not read.

    Raises:
        ValueError: if it is no safetensors file.
    """
    try:
        with safe_open(path, "pt") as file:
            parts = {name: file.get_slice(name) for name in file.keys()}
            return {
                name: (DTYPES.get(part.get_dtype(), part.get_dtype()), tuple(part.get_shape()))
                for name, part in parts.items()
            }
    except SafetensorError as error:
        raise ValueError(f"{path} is not a safetensors file: {one_line(error)}.") from error


def count_tensors(folder: str | Path, kind: str) -> int:
    """How many tensors the weights of a folder hold."""
    return len(read_header(paths(folder, kind)[0]))


def file_checksum(path: Path) -> str:
    """SHA-256 of a file, as ``sha256sum`` prints it."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def paths(folder: str | Path, kind: str) -> tuple[Path, Path]:
    """Where the weights and the JSON of a folder lie."""
    return Path(folder) / f"{kind}.safetensors", Path(folder) / f"{kind}.json"


def _entry(entry: tuple[str, tuple[int, ...]] | None) -> str:
    return "nothing" if entry is None else f"{entry[0]} of shape {entry[1]}"


def check_new(path: Path) -> None:
    """Whether a file can be made there, asked before any work is done.

    Raises:
        FileExistsError: if there is something.
        FileNotFoundError: if there is no folder for it.
    """
    if path.exists() or path.is_symlink():
        raise FileExistsError(f"{path} exists and is not overwritten: choose another name.")
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path}: there is no folder {path.parent}: make it first.")


def write_new(path: Path, data: bytes) -> None:
    """Write a file that does not exist yet, down to the disk.

    Raises:
        FileExistsError: if it does.
    """
    with path.open("xb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
