"""Robots and scenes as YAML files or mappings: reading them, and refusing them in one line.

A refusal names the file, the field, its value and what is allowed. Text is never interpolated, and no
tag of YAML builds an object.
"""

from __future__ import annotations

import difflib
import reprlib
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from torchrl_morl import arguments

SUFFIXES = (".yaml", ".yml")

# A scene of a hundred boxes takes 10 kB.
_MAX_BYTES = 1_000_000

_REPR = reprlib.Repr()
_REPR.maxlevel = 3
_REPR.maxstring = _REPR.maxother = _REPR.maxlong = 60


class _Loader(yaml.SafeLoader):
    """YAML's safe loader, which would keep the last of two fields of the same name in silence."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key_node, _ in node.value:
            if not isinstance(key_node, yaml.ScalarNode) or key_node.value == "<<":
                continue
            key = key_node.value
            if key in seen:
                raise yaml.constructor.ConstructorError(
                    problem=f"the field {shown(key)} stands here twice",
                    problem_mark=key_node.start_mark,
                )
            seen.add(key)
        return super().construct_mapping(node, deep)


def shown(value: Any) -> str:
    """A value in one short line, whatever it is."""
    return arguments.shown(value, _REPR)


def is_description(source: Any) -> bool:
    """Whether this is a YAML file's path, or a mapping."""
    if isinstance(source, str):
        return source.lower().endswith(SUFFIXES)
    return isinstance(source, (Mapping, Path))


def read_yaml(path: str | Path) -> dict[Any, Any]:
    """Fields of a YAML file.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is none, cannot be read, or holds anything but fields.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path}: there is no such file (searched from {Path.cwd()}).")
    if not path.is_file() or path.suffix.lower() not in SUFFIXES:
        raise ValueError(f"{path} must be a file that ends in {' or '.join(SUFFIXES)}.")
    if path.stat().st_size > _MAX_BYTES:
        raise ValueError(f"{path} has {path.stat().st_size:,} bytes, at most {_MAX_BYTES:,}.")
    try:
        values = yaml.load(path.read_text(encoding="utf-8"), Loader=_Loader)
    except yaml.YAMLError as error:
        raise ValueError(f"{path} is not YAML: {_reason(error)}.") from None
    except OSError as error:
        raise ValueError(f"{path} cannot be read: {error.strerror}.") from None
    except RecursionError:
        raise ValueError(f"{path} is not YAML of this kind: it is nested too deeply.") from None
    except ValueError as error:  # no UTF-8, or a date that does not exist
        raise ValueError(f"{path} is not YAML: {' '.join(str(error).split())[:200]}.") from None
    if not isinstance(values, dict):
        raise ValueError(f"{path} must hold fields, such as 'name: mine', got {shown(values)}.")
    return values


def portable(source: Any) -> Any:
    """What a card can keep: the fields of a file and its name, and anything else as it is.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: as :func:`read_yaml`.

    Examples:
        >>> portable("static")
        'static'
    """
    if isinstance(source, Mapping) or not is_description(source):
        return source
    return {"name": Path(source).stem, **read_yaml(source)}


def _reason(error: yaml.YAMLError) -> str:
    """In one line, with the place."""
    problem = getattr(error, "problem", None) or str(error)
    mark = getattr(error, "problem_mark", None)
    place = f"line {mark.line + 1}, column {mark.column + 1}: " if mark else ""
    return place + " ".join(problem.split())[:200]


class Fields:
    """The fields of one robot or scene, each of which says what is wrong with it.

    Args:
        source: path of a YAML file, or a mapping.
        kind: of what, for messages.
        known: names of all fields.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: for what is no file of fields, and for a field that does not exist.
    """

    def __init__(
        self, source: str | Path | Mapping[str, Any], kind: str, known: Collection[str]
    ) -> None:
        if isinstance(source, Mapping):
            self.where, self.values, default = f"the mapping of the {kind}", dict(source), "custom"
        else:
            self.where, self.values, default = str(source), read_yaml(source), Path(source).stem
        self.refuse_unknown(self.values, known)
        self.name = self.values.get("name", default)
        if not is_name(self.name):
            raise self.refusal("name", "text of one line, in quotes if need be", self.name)

    def refuse_unknown(
        self, values: Mapping[Any, Any], known: Collection[str], at: str = ""
    ) -> None:
        """Refuse fields that are not among the known ones.

        Raises:
            ValueError: for the first of them.
        """
        for name in values:
            if name not in known:
                near = difflib.get_close_matches(str(name), known, n=1)
                hint = f" Did you mean {near[0]!r}?" if near else ""
                raise ValueError(
                    f"{self.where}: unknown field {shown(name)}{at}.{hint} "
                    f"Fields are {', '.join(known)}."
                )

    def refusal(self, field: str, allowed: str, value: Any, hint: str = "") -> ValueError:
        """The error of a field whose value is not what is allowed."""
        hint = f" {hint}" if hint else ""
        return ValueError(f"{self.where}: {field} must be {allowed}, got {shown(value)}.{hint}")


def is_name(value: Any) -> bool:
    """Whether it is text of one line."""
    return isinstance(value, str) and bool(value.strip()) and value.isprintable()


def is_list(value: Any) -> bool:
    """Whether it is a list, also one of a configuration."""
    return isinstance(value, Sequence) and not isinstance(value, (str, bytes))


def number_hint(value: Any) -> str:
    """What to do about text that would be a number elsewhere: YAML reads 1e-3 as text."""
    try:
        return f"Write {float(value)!r}." if isinstance(value, str) else ""
    except ValueError:
        return ""
