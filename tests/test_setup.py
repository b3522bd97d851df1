"""The set-up a newcomer meets first: pins, make targets and their error messages."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import tomllib
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS = PROJECT["optional-dependencies"]
TARGETS = ("demo", "train", "test", "lint", "format", "clean", "help")

needs_make = pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")


def direct_requirements() -> list[Requirement]:
    lines = [*PROJECT["dependencies"], *(line for extra in EXTRAS.values() for line in extra)]
    requirements = [Requirement(line) for line in lines]
    return [r for r in requirements if canonicalize_name(r.name) != PROJECT["name"]]


def pins() -> dict[str, str]:
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    lines = [line for line in lines if line and not line.startswith("#")]
    return {canonicalize_name(name): version for name, version in (x.split("==") for x in lines)}


def make(*args: str, cwd: Path = ROOT, **env: str) -> subprocess.CompletedProcess[str]:
    """Run make as a user would, even when this test itself runs under ``make test``."""
    clean = {k: v for k, v in os.environ.items() if k not in {"MAKEFLAGS", "MFLAGS", "MAKELEVEL"}}
    return subprocess.run(
        ["make", *args],
        cwd=cwd,
        env=clean | env,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=120,
    )


def fake_python(path: Path, body: str) -> Path:
    path.write_text(f"#!/bin/sh\n{body}\n")
    path.chmod(0o755)
    return path


@pytest.mark.parametrize("requirement", direct_requirements(), ids=str)
def test_direct_dependency_is_pinned_within_its_range(requirement: Requirement) -> None:
    version = pins()[canonicalize_name(requirement.name)]
    assert requirement.specifier.contains(version)


def test_promised_extras_exist() -> None:
    assert {"test", "dev", "viz"} <= EXTRAS.keys()


def test_library_imports_with_its_core_dependencies_alone() -> None:
    """Every module of the library imports where nothing from the extras is installed.

    TorchRL itself imports MuJoCo where it finds it, so the extras are hidden rather than looked for afterwards.
    """
    code = """
import importlib, pkgutil, sys
for name in sys.argv[1:]:
    sys.modules[name] = None
import torchrl_morl
for module in pkgutil.walk_packages(torchrl_morl.__path__, "torchrl_morl."):
    importlib.import_module(module.name)
"""
    hidden = ["envs", "recipes", "mujoco", "gymnasium", "mo_gymnasium", "matplotlib", "imageio"]
    hidden += ["imageio_ffmpeg", "hydra", "tqdm", "tensorboard", "moocore", "pytest"]
    run = subprocess.run(
        [sys.executable, "-c", code, *hidden], cwd=ROOT, capture_output=True, text=True, timeout=120
    )
    assert run.returncode == 0, run.stderr


@needs_make
def test_make_alone_lists_every_target() -> None:
    run = make()
    assert run.returncode == 0
    for target in TARGETS:
        assert re.search(rf"^  {target}\s+\w", run.stdout, re.MULTILINE), target


@needs_make
def test_missing_python_is_named(tmp_path: Path) -> None:
    run = make("demo", "PYTHON=/nonexistent/python", f"VENV={tmp_path / 'venv'}")
    assert run.returncode != 0
    assert "'/nonexistent/python' was not found, need >= 3.11" in run.stderr
    assert "make PYTHON=python3.11 demo" in run.stderr


@needs_make
@pytest.mark.parametrize("version", ["2.7.18", "3.8.18", "3.10.13"])
def test_old_python_is_refused_with_the_version_found(tmp_path: Path, version: str) -> None:
    python = fake_python(tmp_path / "python", f"echo {version}")
    run = make("demo", f"PYTHON={python}", f"VENV={tmp_path / 'venv'}")
    assert run.returncode != 0
    assert f"found Python {version} ('{python}'), need >= 3.11" in run.stderr
    assert "make PYTHON=python3.11 demo" in run.stderr
    assert not (tmp_path / "venv").exists()


@needs_make
def test_missing_venv_module_is_explained(tmp_path: Path) -> None:
    body = f'case "$2" in *ensurepip*) exit 1;; esac\nexec {sys.executable} "$@"'
    python = fake_python(tmp_path / "python", body)
    run = make("demo", f"PYTHON={python}", f"VENV={tmp_path / 'venv'}")
    assert run.returncode != 0
    assert "apt-get install python3-venv" in run.stderr


@needs_make
def test_failed_install_is_explained_and_an_interrupted_one_rebuilt(tmp_path: Path) -> None:
    venv = tmp_path / "venv"
    venv.mkdir()
    for name in (".unfinished", "half-written"):
        (venv / name).touch()
    run = make(
        "demo",
        f"PYTHON={sys.executable}",
        f"VENV={venv}",
        PIP_NO_INDEX="1",
        PIP_FIND_LINKS=str(tmp_path),
    )
    assert run.returncode != 0
    assert "pip could not install the dependencies" in run.stderr
    assert "PIP_NO_INDEX=1 PIP_FIND_LINKS=" in run.stderr
    assert not (venv / "half-written").exists()
    assert not (venv / ".installed").exists()


@needs_make
def test_a_folder_that_is_no_environment_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").touch()
    run = make("demo", f"PYTHON={sys.executable}", f"VENV={tmp_path}")
    assert run.returncode != 0
    assert "is not a virtual environment" in run.stderr
    assert (tmp_path / "thesis.tex").exists()


@needs_make
def test_clean_keeps_runs(tmp_path: Path) -> None:
    shutil.copy(ROOT / "Makefile", tmp_path)
    kept, removed = tmp_path / "runs" / "policy.pt", tmp_path / ".venv" / "pyvenv.cfg"
    for path in (kept, removed):
        path.parent.mkdir()
        path.touch()
    assert make("clean", cwd=tmp_path).returncode == 0
    assert kept.exists()
    assert not removed.parent.exists()


def test_shell_scripts_parse() -> None:
    subprocess.run(["sh", "-n", ROOT / "tools" / "bootstrap.sh"], check=True)
    subprocess.run(["bash", "-n", ROOT / ".ci" / "run"], check=True)
    assert os.access(ROOT / ".ci" / "run", os.X_OK)
