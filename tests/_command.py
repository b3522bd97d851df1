"""Recipes from the command line, as a user runs them."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


def run(module: str, *args: object) -> subprocess.CompletedProcess[str]:
    """``python -m module args`` in the checkout."""
    return subprocess.run(
        [sys.executable, "-m", module, *map(str, args)],
        cwd=ROOT,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=300,
    )


def run_here(main: Callable[[], None], *arguments: str) -> None:
    """A recipe's ``main`` in this process, which has paid for its imports."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HYDRA_FULL_ERROR", "1")
        patch.setattr(sys, "argv", ["recipe.py", *arguments])
        main()
