"""What ``--help`` of a recipe prints: every field with its default, what it allows and what it means."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from .validation import leaves, select


def help_text(
    module: str, about: str, schema: type[BaseModel], defaults: Mapping[str, Any], folder: Path
) -> str:
    """Usage, fields and examples.

    Args:
        module: of the recipe.
        about: its first sentences.
        schema: of its configuration.
        defaults: of its YAML.
        folder: of its YAML; what can be chosen as a whole lies in folders there.
    """
    command = f"python -m {module}"
    lines = [f"usage: {command} [FIELD=VALUE ...] [--multirun] [--debug]", "", about, "", "fields:"]
    for leaf in leaves(schema):
        default = as_given(select(defaults, leaf.name))
        lines.append(f"  {leaf.name}={default}")
        lines.append(f"      {leaf.description} ({leaf.allowed})")
    for group in sorted(path for path in folder.iterdir() if any(path.glob("*.yaml"))):
        names = sorted(path.stem for path in group.glob("*.yaml"))
        lines.append(f"  {group.name}={'none' if 'none' in names else names[0]}")
        lines.append(f"      Fields that are set together. ({' or '.join(names)})")
    lines += [
        "  hydra.run.dir=...",
        "      Folder that the run writes to; must be new or empty. (a folder)",
        "",
        "options:",
        "  --multirun, -m   one run after the other for every value: seed=0,1,2",
        "  --cfg job        print the configuration and end",
        "  --debug          show the traceback of an error",
        "",
        "examples:",
        f"  {command} seed=1",
        f"  {command} hydra.run.dir='runs/my run'",
        f"  {command} --multirun seed=0,1,2",
    ]
    return "\n".join(lines)


def as_given(value: Any) -> str:
    """A value as on the command line.

    Examples:
        >>> as_given([1, None]), as_given(True), as_given(3e-4)
        ('[1,null]', 'true', '0.0003')
    """
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list):
        return f"[{','.join(map(as_given, value))}]"
    return str(value)
