"""The wheel: what it holds, and that it works where nothing but its requirements is installed."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import tomllib
import zipfile
from importlib.metadata import Distribution, distribution, packages_distributions
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import torchrl_morl

ROOT = Path(__file__).resolve().parent.parent
EXTRAS = {"viz", "indicators", "export", "hub"}
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("hatchling") is None,
    reason="hatchling, which builds the wheel, is not installed: it is in the group 'test'",
)


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """A folder with the unpacked wheel, as pip would leave it."""
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    run = subprocess.run(build, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert run.returncode == 0, run.stderr
    (wheel,) = folder.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder / "site")
    return folder / "site"


@pytest.fixture(scope="module")
def metadata(site) -> Distribution:
    (folder,) = site.glob("*.dist-info")
    return Distribution.at(folder)


def closure(wheel: Distribution, extras: set[str]) -> set[str]:
    """Names of everything that pip would install for the wheel."""
    done: set[tuple[str, str]] = set()
    todo = [(wheel, extra) for extra in ("", *extras)]
    while todo:
        found, extra = todo.pop()
        for requirement in map(Requirement, found.requires or ()):
            if requirement.marker is None or requirement.marker.evaluate({"extra": extra}):
                name = canonicalize_name(requirement.name)
                new = {(name, wanted) for wanted in ("", *requirement.extras)} - done
                done |= new
                todo += [(distribution(name), wanted) for _, wanted in new]
    return {name for name, _ in done}


def ask(question: str, site: Path, wheel: Distribution, extras: set[str], cwd: Path) -> None:
    """Put a question of ``_installed.py`` to the wheel, in an empty folder."""
    visible = closure(wheel, extras)
    hidden = {"envs", "recipes", "examples", "tests", "benchmarks"}
    for package, owners in packages_distributions().items():
        if not visible & {canonicalize_name(owner) for owner in owners}:
            hidden.add(package)
    script = Path(__file__).with_name("_installed.py")
    command = [sys.executable, "-P", str(script), question, str(site), *sorted(hidden)]
    run = subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=600)
    assert run.returncode == 0, run.stdout + run.stderr


def test_it_holds_the_library_alone(site):
    files = {path.relative_to(site).as_posix() for path in site.rglob("*") if path.is_file()}
    library = {path for path in files if path.startswith("torchrl_morl/")}
    sources = (path for path in (ROOT / "torchrl_morl").rglob("*.py"))
    assert library == {path.relative_to(ROOT).as_posix() for path in sources} | {
        "torchrl_morl/py.typed"
    }
    assert {path.split("/")[0].rpartition(".")[2] for path in files - library} == {"dist-info"}
    assert [path for path in files if path.endswith("licenses/LICENSE")]


def test_its_metadata_is_that_of_the_project(metadata):
    assert metadata.version == torchrl_morl.__version__
    assert metadata.metadata["Requires-Python"] == PROJECT["requires-python"]
    assert set(metadata.metadata.get_all("Provides-Extra")) == EXTRAS
    assert "mujoco" not in closure(metadata, EXTRAS)


def test_core_dependencies_alone_import_everything_and_the_rest_names_its_extra(
    site, metadata, tmp_path
):
    ask("alone", site, metadata, set(), tmp_path)


def test_docstring_examples_work_with_its_extras(site, metadata, tmp_path):
    ask("with extras", site, metadata, EXTRAS, tmp_path)
