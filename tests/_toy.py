"""A recipe that counts, and how its command is run and looked at."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType

import pytest

TOY = '''"""Toy: counts.

More about it.
"""

from typing import Annotated

from pydantic import Field

from recipes.training import command
from recipes.training.fields import Allows, Count, IsPath, RunFolder, Section


class Inner(Section):
    size: Count = Field(description="Size of it, metres.")
    names: list[str] | None = Field(None, description="Names of it.")


class Config(Section):
    steps: Count = Field(description="Steps to take.")
    source: Annotated[str, IsPath(), Allows("a file")] | None = Field(description="File to read.")
    resume: RunFolder | None = Field(description="Run to go on from.")
    inner: Inner


@command.recipe("toy", Config)
def main(cfg):
    act(cfg)


def act(cfg):
    pass
'''
YAML = """
steps: 3
source: null
resume: null
inner:
  size: 1
hydra:
  run:
    dir: ${new_run:runs/toy}
  sweep:
    dir: ${new_run:runs/toy}
    subdir: ${hydra.job.num}
"""


def run(toy: ModuleType, *arguments: str) -> int:
    """Its exit code."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["toy.py", *arguments])
        try:
            toy.main()
        except SystemExit as stop:
            return stop.code
    return 0


def begun(folder: Path) -> None:
    """A run that was cut short."""
    (folder / "checkpoints").mkdir(parents=True)
    (folder / ".hydra").mkdir()
    (folder / ".hydra" / "overrides.yaml").write_text("[]")


def written(tmp_path: Path) -> list[str]:
    """What a command has left, but for the recipe and the folder that runs stand in."""
    return sorted(
        str(path.relative_to(tmp_path))
        for path in tmp_path.rglob("*")
        if not path.is_relative_to(tmp_path / "Käfer (1), a=b") and path.is_file()
    )


def only_line(capsys) -> str:
    printed = capsys.readouterr()
    assert printed.out == ""
    (line,) = printed.err.splitlines()
    return line
