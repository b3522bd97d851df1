"""The page's modules, run by node."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

HERE = Path(__file__).resolve().parent

needs_node = pytest.mark.skipif(
    shutil.which("node") is None, reason="node is not installed: it runs the page's JavaScript"
)


def node(program: str, job: dict[str, Any], folder: Path) -> Any:
    """What a program of this folder prints for a job, as JSON values."""
    file = folder / "job.json"
    file.write_text(json.dumps(job))
    run = subprocess.run(
        ["node", HERE / program, file], capture_output=True, text=True, timeout=120, check=False
    )
    assert run.returncode == 0, run.stderr
    return json.loads(run.stdout)
