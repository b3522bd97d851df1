"""What several tests of deployment need and takes seconds to make."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.cpp_library import build_library, compiler
from torchrl_morl.deploy import export_onnx, load_policy

from ._stops import LIDAR

POLICIES = Path(__file__).parents[3] / "recipes" / "policies"


@pytest.fixture(scope="session")
def exported(tmp_path_factory) -> Path:
    """The shipped policy as an ONNX file, for ``LIDAR``."""
    pytest.importorskip("onnxscript")
    file = tmp_path_factory.mktemp("onnx") / "navigation.onnx"
    return export_onnx(load_policy(POLICIES / "polished_seed0"), file, lidar=LIDAR)


@pytest.fixture(scope="session")
def exported_walking(policy_folders, tmp_path_factory) -> Path:
    """One that reads the human's velocity."""
    pytest.importorskip("onnxscript")
    file = tmp_path_factory.mktemp("onnx") / "walking.onnx"
    return export_onnx(load_policy(policy_folders["walking"]), file, lidar=LIDAR)


@pytest.fixture(scope="session")
def cpp_library(tmp_path_factory) -> Path:
    """The C++ runner as a shared library."""
    if compiler() is None:
        pytest.skip("there is no C++ compiler: install g++ or clang++")
    return build_library(tmp_path_factory.mktemp("cpp"))
