"""The recipe that tests of the command line run."""

from __future__ import annotations

import importlib.util
import sys
from types import ModuleType

import pytest

from tests._toy import TOY, YAML


@pytest.fixture
def toy(tmp_path, monkeypatch) -> ModuleType:
    """A recipe, in a folder with a name that Hydra's grammar cannot read."""
    folder = tmp_path / "Käfer (1), a=b"
    (folder / "preset").mkdir(parents=True)
    (folder / "preset" / "large.yaml").write_text("# @package _global_\nsteps: 9\n")
    (folder / "toy.yaml").write_text(YAML)
    (folder / "toy.py").write_text(TOY)
    spec = importlib.util.spec_from_file_location("toy", folder / "toy.py")
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "toy", module)
    spec.loader.exec_module(module)
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    return module
