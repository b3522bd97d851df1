"""Checks a whole configuration against its schema: what is wrong is one line with field, value and what is allowed."""

from __future__ import annotations

import difflib
import importlib.util
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from pydantic import BaseModel, ValidationError

from .allowed import allowed_by, is_section, leaves, type_at, violated


class ConfigurationError(ValueError):
    """A configuration that its recipe refuses, in one line."""


def validate(
    schema: type[BaseModel], config: Mapping[str, Any], *, planned: Path | None = None
) -> None:
    """Check a configuration, and that what it names is there.

    Args:
        schema: of the recipe.
        config: plain dictionaries; what is still missing has the value ``"???"``.

    Keyword Args:
        planned: a folder; what lies in it need not be there yet.

    Raises:
        ConfigurationError: for the first field that is refused, in one line; it names the others.
    """
    try:
        schema.model_validate(_given(config))
    except ValidationError as error:
        raise ConfigurationError(_one_line(schema, error)) from error
    try:
        check_surroundings(schema, config, planned=planned)
    except ValueError as error:
        raise ConfigurationError(str(error)) from error


def check_surroundings(
    schema: type[BaseModel], config: Mapping[str, Any], *, planned: Path | None = None
) -> None:
    """What a valid configuration needs of this machine: files, a device, packages of loggers.

    Raises:
        ValueError: for what is not there.
    """
    device = config.get("device", "cpu")
    if device != "cpu" and not torch.cuda.is_available():
        raise ValueError(
            f"device={device}: PyTorch {torch.__version__} finds no such device here: use device=cpu, or install "
            "PyTorch for CUDA and a driver (https://pytorch.org)."
        )
    for backend in config.get("logger", {}).get("backends", ()):
        if backend != "csv" and importlib.util.find_spec(backend) is None:
            raise ValueError(
                f"logger.backends: {backend} is not installed: pip install {backend}, or leave it out."
            )
    if select(config, "collector.backend") == "ray" and importlib.util.find_spec("ray") is None:
        raise ValueError(
            "collector.backend: ray is not installed: pip install 'ray>=2.50,<3', or give direct."
        )
    for leaf in leaves(schema):
        value = select(config, leaf.name)
        if leaf.path is None or not isinstance(value, str):
            continue
        if planned is None or planned not in Path(value).parents:
            leaf.path.check(leaf.name, value)


def select(config: Mapping[str, Any], name: str) -> Any:
    """The value of ``optim.lr``; ``None`` where a section is missing."""
    value: Any = config
    for part in name.split("."):
        value = value.get(part) if isinstance(value, Mapping) else None
    return value


def nearest(name: str, known: list[str]) -> str | None:
    """The field that was meant: with the same end or nearly the same letters."""
    end = name.rsplit(".", 1)[-1]
    if same := [one for one in known if one.rsplit(".", 1)[-1] == end]:
        return difflib.get_close_matches(name, same, 1, cutoff=0.0)[0]
    ends = {one.rsplit(".", 1)[-1]: one for one in reversed(known)}
    found = difflib.get_close_matches(name, known, 1, cutoff=0.75)
    return (
        found[0]
        if found
        else next(
            (ends[one] for one in difflib.get_close_matches(end, list(ends), 1, cutoff=0.75)), None
        )
    )


def unknown_field(name: str, schema: type[BaseModel]) -> str:
    """The line for a field that there is not."""
    meant = nearest(name, [leaf.name for leaf in leaves(schema)])
    hint = f"did you mean {meant}?" if meant else "--help lists the fields."
    return f"there is no field {name}: {hint}"


def _given(config: Mapping[str, Any]) -> dict[str, Any]:
    return {
        name: _given(value) if isinstance(value, Mapping) else value
        for name, value in config.items()
        if value != "???"
    }


def _one_line(schema: type[BaseModel], error: ValidationError) -> str:
    errors = error.errors(include_url=False)
    first = _line(schema, errors[0])
    names = list(dict.fromkeys(_name(one["loc"]) for one in errors))[1:]
    return f"{first} (Also refused: {', '.join(names)}.)" if names else first


def _line(schema: type[BaseModel], error: Mapping[str, Any]) -> str:
    name, kind, value = _name(error["loc"]), error["type"], error["input"]
    if kind == "extra_forbidden":
        return unknown_field(name, schema)
    annotation, metadata, optional = type_at(schema, error["loc"])
    if kind == "missing":
        description = _description(schema, error["loc"])
        return f"{name} must be given: {description}"
    if kind == "value_error":
        message = str(error["ctx"]["error"])
        if not error["loc"] or annotation is schema or is_section(annotation):
            return message
        return f"{name} {message}" if message.startswith("must") else f"{name}: {message}"
    if kind in ("greater_than", "greater_than_equal", "less_than", "less_than_equal"):
        must = f"must be {violated(annotation, metadata, kind)}"
        must = must.replace("be not negative", "not be negative")
    elif is_section(annotation):
        must = "must be a mapping of fields"
    else:
        must = f"must be {allowed_by(annotation, metadata)}{', or null' if optional else ''}"
    return f"{name} {must}, got {value!r}."


def _description(schema: type[BaseModel], loc: tuple) -> str:
    """What a field is about."""
    name = ".".join(map(str, loc))
    return next((leaf.description for leaf in leaves(schema) if leaf.name == name), "see --help.")


def _name(loc: tuple) -> str:
    name = ""
    for part in loc:
        name += f"[{part}]" if isinstance(part, int) else f".{part}" if name else str(part)
    return name
