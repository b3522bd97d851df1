"""What a field allows, from its type: for the error, and for ``--help``."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from .fields import Allows, IsPath, MayImport


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
    def is_mapping(self) -> bool:
        """If its keys are the user's."""
        return get_origin(_unwrap(self.field.annotation, ())[0]) is dict

    @property
    def may_import(self) -> bool:
        """If a value with a colon imports a module."""
        return any(isinstance(one, MayImport) for one in _metadata(self.field))

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


def allowed(field: FieldInfo) -> str:
    """What a field allows, ``a whole number at least 1``."""
    return allowed_by(field.annotation, tuple(field.metadata))


def allowed_by(annotation: Any, metadata: tuple) -> str:
    """What a type with its metadata allows."""
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
        return f"{count}, each {allowed_by(item, ())}"
    name = {int: "a whole number", float: "a number"}.get(annotation, "a text")
    range_ = limits(annotation, metadata)
    if range_ == "positive":
        return f"a positive {name[2:]}"
    comma = "," if range_ == "not negative" else ""
    return f"{name}{comma} {range_}" if range_ else name


def limits(annotation: Any, metadata: tuple) -> str:
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
    if low is None and above is None and below is None:
        return f"at most {high:g}"
    left = f"[{low:g}" if low is not None else f"({above:g}"
    right = f"{high:g}]" if high is not None else f"{below:g})"
    return f"in {left}, {right}"


def _first(metadata: tuple, name: str) -> Any:
    """Of those pieces of metadata that have such an attribute."""
    return next((getattr(one, name) for one in metadata if hasattr(one, name)), None)


def violated(annotation: Any, metadata: tuple, kind: str) -> str:
    """Of a range the end that matters, where its other end is only far away."""
    if annotation is int:
        if kind.startswith("greater"):
            return f"at least {_first(metadata, 'ge')}"
        return f"at most {_first(metadata, 'le')}"
    return limits(annotation, metadata)


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


def type_at(schema: type[BaseModel], loc: tuple) -> tuple[Any, tuple, bool]:
    """Type, metadata, and whether null is allowed, at a place in a schema."""
    found: tuple[Any, tuple, bool] = (schema, (), False)
    for part in loc:
        annotation = found[0]
        if isinstance(part, int) and get_origin(annotation) is list:
            found = _unwrap(get_args(annotation)[0], ())
        elif is_section(annotation) and part in annotation.model_fields:
            field = annotation.model_fields[part]
            found = _unwrap(field.annotation, tuple(field.metadata))
    return found


def is_section(annotation: Any) -> bool:
    """Whether a type is a part of a configuration, with fields of its own."""
    return isinstance(annotation, type) and issubclass(annotation, BaseModel)
