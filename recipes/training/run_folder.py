"""The run folder of a training: what made it."""

from __future__ import annotations

import importlib.metadata
import json
import platform
import shutil
import subprocess
import time
from pathlib import Path
from typing import Any


def check_run_dir(run_dir: Path) -> None:
    """Refuse a folder that another training has left policies in, before hours of training."""
    policies = run_dir / "policies"
    if policies.exists():
        raise FileExistsError(
            f"{policies} exists and is not overwritten: choose another hydra.run.dir."
        )


def write_run_info(run_dir: Path) -> None:
    """Versions and git state, beside the resolved configuration that Hydra writes."""
    packages = ("torch", "torchrl", "tensordict", "mujoco", "numpy")
    info = {
        "started": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        "python": platform.python_version(),
        "versions": {name: importlib.metadata.version(name) for name in packages},
        "git": _git_state(run_dir),
    }
    (run_dir / "run.json").write_text(json.dumps(info, indent=2) + "\n")


def _git_state(run_dir: Path) -> dict[str, Any] | None:
    if shutil.which("git") is None:
        return None

    def git(*arguments: str) -> subprocess.CompletedProcess:
        where = Path(__file__).parent
        return subprocess.run(["git", *arguments], cwd=where, capture_output=True, text=True)

    commit = git("rev-parse", "HEAD")
    if commit.returncode:
        return None
    diff = git("diff", "HEAD").stdout
    if diff:
        (run_dir / "uncommitted.diff").write_text(diff)
    return {"commit": commit.stdout.strip(), "uncommitted_changes": bool(diff)}
