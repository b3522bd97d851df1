"""The set-up a newcomer meets first: pins, make targets and their error messages."""

from __future__ import annotations

import ast
import importlib.metadata
import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name

import torchrl_morl

ROOT = Path(__file__).resolve().parent.parent
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PROJECT, GROUPS = PYPROJECT["project"], PYPROJECT["dependency-groups"]
EXTRAS = PROJECT["optional-dependencies"]
ROOMS = ("torchrl_morl", "envs", "recipes", "examples", "tests", "benchmarks", "tools")
TARGETS = (
    "demo",
    "page",
    "train",
    "test",
    "test-ros",
    "lint",
    "format",
    "docs",
    "linkcheck",
    "lock",
    "clean",
    "help",
)

needs_make = pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")


def requirements_of(group: str) -> list[str]:
    """The lines of a dependency group and of those that it includes."""
    lines = []
    for line in GROUPS[group]:
        lines += [line] if isinstance(line, str) else requirements_of(line["include-group"])
    return lines


def direct_requirements() -> list[Requirement]:
    lines = [*PROJECT["dependencies"], *(line for extra in EXTRAS.values() for line in extra)]
    lines += [line for group in GROUPS.values() for line in group if isinstance(line, str)]
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


@pytest.mark.parametrize("requirement", direct_requirements(), ids=str)
def test_direct_dependency_runs_on_the_oldest_python(requirement: Requirement) -> None:
    """Otherwise a resolver for every Python, uv's, finds no answer."""
    oldest = SpecifierSet(PROJECT["requires-python"])
    (version,) = (specifier.version for specifier in oldest)
    try:
        needs = importlib.metadata.metadata(requirement.name)["Requires-Python"] or ""
    except importlib.metadata.PackageNotFoundError:
        pytest.skip(f"{requirement.name} is not installed")
    assert SpecifierSet(needs).contains(version)


def test_extras_are_those_of_the_wheel_and_the_rest_are_groups() -> None:
    assert EXTRAS.keys() == {"viz", "indicators", "export", "hub"}
    assert GROUPS.keys() == {
        "sim",
        "recipes",
        "live",
        "bags",
        "ray",
        "references",
        "test",
        "docs",
        "dev",
    }


def test_uv_installs_the_versions_of_constraints_txt() -> None:
    """To repair it: make lock."""
    locked: dict[str, set[str]] = {}
    for package in tomllib.loads((ROOT / "uv.lock").read_text())["package"]:
        locked.setdefault(package["name"], set()).add(package.get("version"))
    expected = {name: {version} for name, version in pins().items()}
    assert {name: locked.get(name) for name in expected} == expected


def test_uv_lock_knows_what_pyproject_asks_for() -> None:
    """To repair it: make lock."""
    packages = tomllib.loads((ROOT / "uv.lock").read_text())["package"]
    (ours,) = (package for package in packages if package["name"] == PROJECT["name"])
    asked, locked = ours["metadata"], {}
    for where, lines in {"": asked["requires-dist"], **asked["requires-dev"]}.items():
        locked[where] = {(line["name"], SpecifierSet(line.get("specifier", ""))) for line in lines}
    core = [*PROJECT["dependencies"], *(line for extra in EXTRAS.values() for line in extra)]
    expected = {"": core, **{group: requirements_of(group) for group in GROUPS}}
    assert locked == {
        where: {(canonicalize_name(r.name), r.specifier) for r in map(Requirement, lines)}
        for where, lines in expected.items()
    }


def test_the_citation_names_the_version() -> None:
    assert f"\nversion: {torchrl_morl.__version__}\n" in (ROOT / "CITATION.cff").read_text()


def imported_names(package: str) -> dict[str, set[str]]:
    """Top-level names imported anywhere in a package, also inside functions, with the files that do."""
    found: dict[str, set[str]] = {}
    for path in (ROOT / package).rglob("*.py"):
        if "loopback" in path.parts:  # ROS has an environment of its own: ros2/requirements.txt
            continue
        for node in ast.walk(ast.parse(path.read_text(), filename=str(path))):
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and not node.level and node.module:
                names = [node.module]
            else:
                continue
            for name in names:
                found.setdefault(name.split(".")[0], set()).add(str(path.relative_to(ROOT)))
    return found


@pytest.mark.parametrize(
    ("package", "extras", "group"),
    [
        ("torchrl_morl", ("viz", "indicators", "export", "hub"), None),
        ("envs", (), "sim"),
        ("recipes", ("viz", "indicators"), "recipes"),
        ("examples", ("viz", "indicators"), "recipes"),
        ("tests", ("viz", "indicators", "export", "hub"), "test"),
        ("benchmarks", ("viz", "indicators", "export", "hub"), "dev"),
    ],
)
def test_what_a_package_imports_is_declared(
    package: str, extras: tuple[str, ...], group: str | None
) -> None:
    lines = [*PROJECT["dependencies"], *(line for extra in extras for line in EXTRAS[extra])]
    if group is not None:
        for own in (group, "references", "live", "bags", "ray"):
            lines += requirements_of(own)
    declared = {canonicalize_name(Requirement(line).name) for line in lines}
    known = {*sys.stdlib_module_names, *ROOMS, "torchrl_morl_ros"}
    owners = importlib.metadata.packages_distributions()
    undeclared = {
        name: files
        for name, files in imported_names(package).items()
        if name not in known
        # What is not installed here is taken for the package of that name.
        and not declared & {canonicalize_name(owner) for owner in owners.get(name, (name,))}
    }
    assert not undeclared


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
@pytest.mark.parametrize("made_by_uv", [True, False])
def test_an_environment_of_uv_is_kept_and_gets_pip(tmp_path: Path, made_by_uv: bool) -> None:
    venv = tmp_path / "venv"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(venv)], check=True)
    if made_by_uv:
        with (venv / "pyvenv.cfg").open("a") as file:
            file.write("uv = 0.13.9\n")
    (venv / "already-there").touch()
    offline = {"PIP_NO_INDEX": "1", "PIP_FIND_LINKS": str(tmp_path)}
    run = make("demo", f"PYTHON={sys.executable}", f"VENV={venv}", **offline)
    assert "pip could not install the dependencies" in run.stderr
    assert (venv / "already-there").exists() == made_by_uv


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
