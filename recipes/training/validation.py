"""Checks a whole configuration against its schema: what is wrong is one line with field, value and what is allowed."""

from __future__ import annotations

import dataclasses
import difflib
import importlib.util
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import torch
from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from .fields import Allows, IsPath


class ConfigurationError(ValueError):
    """A configuration that its recipe refuses, in one line."""


@dataclasses.dataclass(frozen=True)
class Leaf:
    """A field of a schema that holds a value and no more fields.

    Args:
        name: as on the command line, ``optim.lr``.
        field: of its section.
        optional: whether the YAML need not have it.
    """

    name: str
    field: FieldInfo
    optional: bool

    @property
    def description(self) -> str:
        return self.field.description or ""

    @property
    def allowed(self) -> str:
        """Type and range, ``a number in (0, 1]``."""
        return allowed(self.field)

    @property
    def path(self) -> IsPath | None:
        """If it is a path."""
        return next((one for one in _metadata(self.field) if isinstance(one, IsPath)), None)


def leaves(schema: type[BaseModel], prefix: str = "") -> Iterator[Leaf]:
    """All fields of a schema, in its order."""
    for name, field in schema.model_fields.items():
        section = _section(field)
        if section is not None:
            yield from leaves(section, f"{prefix}{name}.")
        else:
            yield Leaf(prefix + name, field, not field.is_required())


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


def allowed(field: FieldInfo) -> str:
    """What a field allows, ``a whole number at least 1``."""
    return _allowed(field.annotation, tuple(field.metadata))


def _allowed(annotation: Any, metadata: tuple) -> str:
    annotation, metadata, optional = _unwrap(annotation, metadata)
    text = next((one.text for one in metadata if isinstance(one, Allows)), None)
    if text is None:
        text = _kind(annotation, metadata)
    return f"{text}, or null" if optional else text


def _kind(annotation: Any, metadata: tuple) -> str:
    if annotation is bool:
        return "true or false"
    if get_origin(annotation) is Literal:
        return _choice([repr(one) for one in get_args(annotation)])
    if get_origin(annotation) is list:
        (item,) = get_args(annotation)
        least, most = _first(metadata, "min_length"), _first(metadata, "max_length")
        count = "a list"
        if least:
            count += f" of {least}" if least == most else f" of at least {least}"
        return f"{count}, each {_allowed(item, ())}"
    name = {int: "a whole number", float: "a number"}.get(annotation, "a text")
    limits = _limits(annotation, metadata)
    if limits == "positive":
        return f"a positive {name[2:]}"
    comma = "," if limits == "not negative" else ""
    return f"{name}{comma} {limits}" if limits else name


def _limits(annotation: Any, metadata: tuple) -> str:
    """The range, as behind "must be"; "" without one."""
    low, above, high, below = (_first(metadata, name) for name in ("ge", "gt", "le", "lt"))
    if annotation is int:
        if low is not None and high is not None:
            return f"from {low} to {high}"
        return "" if low is None else f"at least {low}"
    if high is None and below is None:
        if above == 0:
            return "positive"
        return "" if low is None else ("not negative" if low == 0 else f"at least {low}")
    left = f"[{low:g}" if low is not None else f"({above:g}"
    right = f"{high:g}]" if high is not None else f"{below:g})"
    return f"in {left}, {right}"


def _first(metadata: tuple, name: str) -> Any:
    """Of those pieces of metadata that have such an attribute."""
    return next((getattr(one, name) for one in metadata if hasattr(one, name)), None)


def _violated(annotation: Any, metadata: tuple, kind: str) -> str:
    """Of a range the end that matters, where its other end is only far away."""
    if annotation is int:
        if kind.startswith("greater"):
            return f"at least {_first(metadata, 'ge')}"
        return f"at most {_first(metadata, 'le')}"
    return _limits(annotation, metadata)


def _choice(values: list[str]) -> str:
    if len(values) < 3:
        return " or ".join(values)
    return f"one of {', '.join(values)}"


def _unwrap(annotation: Any, metadata: tuple) -> tuple[Any, tuple, bool]:
    """The type below ``Annotated`` and ``| None``, with all its metadata, and whether null is allowed."""
    optional = False
    while True:
        if get_origin(annotation) is Annotated:
            annotation, *more = get_args(annotation)
            metadata = (*metadata, *_flat(more))
        elif get_origin(annotation) in (Union, UnionType):
            (annotation,) = (one for one in get_args(annotation) if one is not NoneType)
            optional = True
        else:
            return annotation, metadata, optional


def _flat(metadata: list) -> list:
    """With what stands in a ``Field(ge=...)`` of an ``Annotated``."""
    return [
        inner
        for one in metadata
        for inner in (one.metadata if isinstance(one, FieldInfo) else [one])
    ]


def _metadata(field: FieldInfo) -> tuple:
    return _unwrap(field.annotation, tuple(field.metadata))[1]


def _section(field: FieldInfo) -> type[BaseModel] | None:
    annotation, _, _ = _unwrap(field.annotation, ())
    return (
        annotation if isinstance(annotation, type) and issubclass(annotation, BaseModel) else None
    )


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
    annotation, metadata, optional = _at(schema, error["loc"])
    if kind == "missing":
        description = _description(schema, error["loc"])
        return f"{name} must be given: {description}"
    if kind == "value_error":
        message = str(error["ctx"]["error"])
        if not error["loc"] or annotation is schema or _is_section(annotation):
            return message
        return f"{name} {message}" if message.startswith("must") else f"{name}: {message}"
    if kind in ("greater_than", "greater_than_equal", "less_than", "less_than_equal"):
        must = f"must be {_violated(annotation, metadata, kind)}"
        must = must.replace("be not negative", "not be negative")
    elif _is_section(annotation):
        must = "must be a mapping of fields"
    else:
        must = f"must be {_allowed(annotation, metadata)}{', or null' if optional else ''}"
    return f"{name} {must}, got {value!r}."


def _description(schema: type[BaseModel], loc: tuple) -> str:
    """What a field is about."""
    name = ".".join(map(str, loc))
    return next((leaf.description for leaf in leaves(schema) if leaf.name == name), "see --help.")


def _at(schema: type[BaseModel], loc: tuple) -> tuple[Any, tuple, bool]:
    """Type, metadata, and whether null is allowed, at a place in a schema."""
    found: tuple[Any, tuple, bool] = (schema, (), False)
    for part in loc:
        annotation = found[0]
        if isinstance(part, int) and get_origin(annotation) is list:
            found = _unwrap(get_args(annotation)[0], ())
        elif _is_section(annotation) and part in annotation.model_fields:
            field = annotation.model_fields[part]
            found = _unwrap(field.annotation, tuple(field.metadata))
    return found


def _is_section(annotation: Any) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, BaseModel)


def _name(loc: tuple) -> str:
    name = ""
    for part in loc:
        name += f"[{part}]" if isinstance(part, int) else f".{part}" if name else str(part)
    return name
