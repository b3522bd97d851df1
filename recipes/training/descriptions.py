"""The run's own copies of files of scenes and robots: what a run began with is what it goes on with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from envs.fields import is_description, portable
from envs.scene_files import portable_scene

from .quoting import quoted, reads_as
from .run_folder import write_atomically
from .validation import select

FIELDS = ("env.scene", "env.robot", "evaluation.scene")
"""Fields that may name a file, which somebody may edit or move while a run rests."""


def copy_descriptions(run: Path, config: Mapping[str, Any], overrides: Sequence[str]) -> None:
    """Keep what the files say that the overrides of a run name, in its folder.

    Args:
        run: its folder.
        config: of the run.
        overrides: that it was begun with.
    """
    given = {_key(one) for one in overrides}
    for field in FIELDS:
        value = select(config, field)
        if field in given and isinstance(value, str) and is_description(value):
            said = portable(value) if field.endswith("robot") else portable_scene(value)
            text = yaml.safe_dump(said, sort_keys=False, allow_unicode=True)
            write_atomically(_copy(run, field), text)


def with_own_copies(run: Path, overrides: Sequence[str]) -> list[str]:
    """Overrides that name the run's copies where it has some, whatever became of the files."""
    found = []
    for one in overrides:
        field, value = _key(one), reads_as(one.partition("=")[2])
        has_file = field in FIELDS and isinstance(value, str) and is_description(value)
        copy = _copy(run, field)
        found.append(f"{field}={quoted(copy)}" if has_file and copy.is_file() else one)
    return found


def _copy(run: Path, field: str) -> Path:
    return run / ".hydra" / f"{field}.yaml"


def _key(override: str) -> str:
    return override.partition("=")[0].lstrip("+~")
