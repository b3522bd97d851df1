"""The command line of a recipe: fields that it has, and paths that Hydra's grammar can read."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser
from pydantic import BaseModel

from .descriptions import with_own_copies
from .quoting import in_quotes, is_harmless, is_of_hydra, is_sweep, quoted, reads_as
from .validation import ConfigurationError, leaves, unknown_field

_FOLDERS = ("hydra.run.dir", "hydra.sweep.dir")
_OVERRIDE = re.compile(r"(?P<sign>\+\+|\+|~|)(?P<key>[^=]*)=(?P<value>.*)", re.DOTALL)
# A hundred overrides take 5 kB.
_MOST_BYTES = 1_000_000


def prepared(
    overrides: Sequence[str], schema: type[BaseModel], folder: Path, *, multirun: bool = False
) -> list[str]:
    """Overrides as Hydra takes them.

    Paths are quoted where they need it, ``+field=`` of a field that there is becomes ``field=``.

    Args:
        overrides: as given by the user.
        schema: of the recipe.
        folder: of its YAML files; the folders in it are Hydra's groups, such as ``preset``.

    Keyword Args:
        multirun: whether ``a,b`` are two values instead of a path with a comma.

    Raises:
        ConfigurationError: for a field that there is not, or what is no override.
    """
    known = {leaf.name: leaf for leaf in leaves(schema)}
    sections = {
        ".".join(parts[:end])
        for name in known
        for parts in [name.split(".")]
        for end in range(1, len(parts))
    }
    result = []
    for override in overrides:
        match = _OVERRIDE.fullmatch(override)
        if match is None or not match["key"].strip():
            if override.startswith("~"):
                raise ConfigurationError(f"{override}: no field can be left out, null is nothing.")
            raise ConfigurationError(f"{override!r} is not field=value; --help lists the fields.")
        sign, key, value = match["sign"], match["key"], match["value"]
        if is_of_hydra(override):
            is_path = key in _FOLDERS
            # Hydra would take the current one.
            if is_path and value.strip("'\" ").lower() in ("", "null"):
                raise ConfigurationError(
                    f"{override}: it is a folder, which has a name, or . for this one."
                )
        elif key in _groups(folder):
            if re.search(r"[/\\]", value):  # Hydra would read a file from anywhere
                raise ConfigurationError(f"{override}: {key} is a name of a file in it, no path.")
            name = reads_as(value)
            if not ((isinstance(name, str) and name) or is_sweep(value)):
                names = ", ".join(sorted(file.stem for file in (folder / key).glob("*.yaml")))
                raise ConfigurationError(f"{override}: {key} is one name, one of {names}.")
            is_path = False
        elif sign == "~":
            raise ConfigurationError(f"{override}: no field can be left out, null is nothing.")
        else:
            owner = next(
                (name for name in known if key == name or key.startswith(f"{name}.")), None
            )
            if owner is None and key not in sections:
                raise ConfigurationError(unknown_field(key, schema))
            is_path = key == owner and known[owner].path is not None
            if owner is not None:
                # What the YAML does not have Hydra adds only if told so.
                leaf = known[owner]
                sign = "++" if leaf.optional or leaf.is_mapping else ""
        if is_path:
            value = _path_value(value, multirun=multirun)
        result.append(f"{sign}{key}={value}")
    return result


def resumed(overrides: Sequence[str], schema: type[BaseModel], folder: Path) -> list[str]:
    """Overrides of a run that goes on: in its folder, with those it began with; the new ones come last.

    Args:
        overrides: as :func:`prepared` gives them; without ``resume=`` they stay as they are.
        schema: of the recipe.
        folder: of its YAML files.

    Raises:
        ConfigurationError: if what the folder says of its overrides cannot be used.
    """
    given = [one.removeprefix("resume=") for one in overrides if one.startswith("resume=")]
    if not given or given[-1] == "null":
        return list(overrides)
    value = OverridesParser.create().parse_override(f"resume={given[-1]}").value()
    if not isinstance(value, str):  # said by the check of the field, or by Hydra
        return list(overrides)
    run = Path(value)
    file = run / ".hydra" / "overrides.yaml"
    if not file.is_file():  # said by the check of the field
        return list(overrides)
    if file.stat().st_size > _MOST_BYTES:
        raise ConfigurationError(
            f"{file} has more than {_MOST_BYTES:,} bytes: it is no list of overrides."
        )
    try:
        kept = yaml.safe_load(file.read_text())
    except RecursionError:
        raise ConfigurationError(f"{file} cannot be read: it is nested too deeply.") from None
    except (yaml.YAMLError, OSError, ValueError) as error:  # a date that does not exist, no UTF-8
        raise ConfigurationError(f"{file} cannot be read: {str(error).splitlines()[0]}") from error
    if not isinstance(kept, list) or not all(isinstance(one, str) for one in kept):
        raise ConfigurationError(f"{file} is no list of overrides: the run cannot go on.")
    if asks := [one for one in kept if not is_harmless(one)]:
        raise ConfigurationError(
            f"{file}: {asks[0]!r} is not taken from a folder; give it yourself."
        )
    try:
        kept = prepared(kept, schema, folder)
    except ConfigurationError as error:
        raise ConfigurationError(f"{file}: {error}") from error
    given = {_key(one) for one in overrides}
    if asks := [one for one in importing(kept, schema) if _key(one) not in given]:
        raise ConfigurationError(
            f"{file}: {asks[0]} imports a module, which is not taken from a folder; give it yourself."
        )
    kept = with_own_copies(run, [one for one in kept if _key(one) != "resume"])
    place = () if any(one.startswith("hydra.run.dir=") for one in overrides) else (run,)
    return [*kept, *overrides, *(f"hydra.run.dir={quoted(one)}" for one in place)]


def importing(overrides: Sequence[str], schema: type[BaseModel]) -> list[str]:
    """The overrides that import a module, such as ``env=module:Name-v0``."""
    names = {leaf.name for leaf in leaves(schema) if leaf.may_import}
    return [one for one in overrides if _key(one) in names and ":" in one]


def _key(override: str) -> str:
    return override.partition("=")[0].lstrip("+~")


def _groups(folder: Path) -> set[str]:
    """Hydra's groups: folders beside a recipe's YAML, such as ``preset``."""
    return {path.name for path in folder.iterdir() if path.is_dir()}


def jobs(overrides: Sequence[str]) -> Iterator[list[str]]:
    """The overrides of every job of a multirun.

    Raises:
        HydraException: for an override that cannot be read.
    """
    parsed = OverridesParser.create().parse_overrides(list(overrides))
    values = [
        [f"{one.get_key_element()}={value}" for value in one.sweep_string_iterator()]
        if one.is_sweep_override()
        else [text]
        for one, text in zip(parsed, overrides, strict=True)
    ]
    for combination in itertools.product(*values):
        yield list(combination)


def _path_value(value: str, *, multirun: bool) -> str:
    if value[:1] in "'\"{" or reads_as(value) == value:  # "" is in every text
        return value
    if value.lower() == "null" or (multirun and is_sweep(value)):
        return value
    read = reads_as(value)
    if isinstance(read, str) and not Path(value).exists():  # the user has escaped it
        return value
    return in_quotes(value)
