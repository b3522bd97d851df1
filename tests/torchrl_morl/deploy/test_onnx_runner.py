"""The runner of an exported file: PolicyRunner's commands and stops, without PyTorch."""

from __future__ import annotations

import math
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from torchrl_morl.deploy import PolicyRunner, load_policy, onnx_runner
from torchrl_morl.deploy.onnx_runner import OnnxRunner

from ._alike import LIMITS, check_limits, check_velocities, drive
from ._stops import LIDAR, NO_INPUTS, STOPS, step

POLICIES = Path(__file__).parents[3] / "recipes" / "policies"
NAN, INF = math.nan, math.inf

pytest.importorskip("onnxruntime")


@pytest.mark.parametrize(("changes", "reason", "detail"), STOPS)
def test_it_stops_for_the_same_reasons(exported, changes, reason, detail):
    runner = OnnxRunner(exported)
    command = step(runner, **changes)
    assert (command.speed, command.turn_rate, command.reason) == (0.0, 0.0, reason)
    assert command.detail and len(command.detail.splitlines()) == 1
    if "preference" not in changes:  # whose messages tell fewer things
        assert detail in command.detail
    assert step(runner, 10.4).reason == "drive"


@pytest.mark.parametrize(("changes", "reason", "detail"), NO_INPUTS)
def test_it_raises_for_nothing_that_it_is_given(exported_walking, changes, reason, detail):
    command = step(OnnxRunner(exported_walking), **{"odometry": (0.0, 0.0, 0.0)} | changes)
    assert (command.speed, command.turn_rate, command.reason) == (0.0, 0.0, reason)
    assert detail in command.detail and len(command.detail.splitlines()) == 1


def test_what_is_wrong_with_a_preference_is_named(exported):
    runner = OnnxRunner(exported)
    found = [
        step(runner, 10.0 + index, preference=preference).detail
        for index, preference in enumerate([(1, 1, 0), (-1, 1, 1), (0.5, 0.5), (NAN, 0, 1)])
    ]
    assert "sums to 2; it must sum to 1 within 0.0001" in found[0]
    assert "preference of 'demo' must be finite and >= 0, got -1" in found[1]
    assert "preference must have shape [3] for ('demo', 'distance', 'efficiency')" in found[2]
    assert "preference of 'demo' must be finite and >= 0, got nan" in found[3]


@pytest.mark.parametrize("name", ["polished_seed0", "walking"])
def test_its_commands_are_those_of_the_runner(policy_folders, name, exported, exported_walking):
    ours = PolicyRunner(load_policy(policy_folders[name]), lidar=LIDAR)
    drive(ours, OnnxRunner(exported if name == "polished_seed0" else exported_walking), LIDAR, 200)


def test_velocities_come_from_odometry(policy_folders, exported_walking):
    ours = PolicyRunner(load_policy(policy_folders["walking"]), lidar=LIDAR)
    check_velocities(ours, OnnxRunner(exported_walking))


@pytest.mark.parametrize("limits", LIMITS)
def test_limits_of_ones_own(exported, limits):
    ours = PolicyRunner(load_policy(POLICIES / "polished_seed0"), lidar=LIDAR, **limits)
    check_limits(ours, OnnxRunner(exported, **limits))


@pytest.mark.parametrize("name", ["goal_radius", "timeout", "max_speed", "max_turn_rate"])
@pytest.mark.parametrize("value", [0.0, NAN, "1", True])
def test_limits_that_make_no_sense(exported, name, value):
    with pytest.raises(ValueError, match=f"{name} must be finite and positive, got {value!r}"):
        OnnxRunner(exported, **{name: value})


def test_files_that_are_refused(exported, tmp_path):
    onnx = pytest.importorskip("onnx")
    with pytest.raises(FileNotFoundError, match="export_onnx writes such a file"):
        OnnxRunner(tmp_path / "none.onnx")
    (tmp_path / "text.onnx").write_text("nothing")
    with pytest.raises(ValueError, match="is no ONNX file") as found:
        OnnxRunner(tmp_path / "text.onnx")
    assert len(str(found.value).splitlines()) == 1
    for name, change, message in (
        ("foreign", {"torchrl_morl_format": None}, "is not a file of export_onnx"),
        ("later", {"torchrl_morl_format": "2"}, "has format 2, this version reads 1"),
        ("broken", {"limits": "{"}, "its metadata is not valid JSON"),
        ("short", {"lidar": None}, "lacks 'lidar' in its metadata"),
    ):
        model = onnx.load(str(exported))
        told = {one.key: one.value for one in model.metadata_props} | change
        del model.metadata_props[:]
        told = {key: value for key, value in told.items() if value is not None}
        onnx.helper.set_model_props(model, told)
        onnx.save(model, str(tmp_path / f"{name}.onnx"))
        with pytest.raises(ValueError, match=message):
            OnnxRunner(tmp_path / f"{name}.onnx")


ALONE = """
import sys

class Refused:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("torch", "torchrl", "tensordict", "torchrl_morl", "onnx", "scipy"):
            raise ImportError(name)

sys.meta_path.insert(0, Refused())
from onnx_runner import OnnxRunner

runner = OnnxRunner("policy.onnx")
command = runner.step(
    [float("inf")] * 360, goal=(3.0, 0.1), preference=(0.2, 0.3, 0.5), stamp=0.0, time=0.0
)
print(command.reason, command.speed, command.turn_rate)
"""


def test_the_file_works_alone(exported, tmp_path):
    """On a robot with NumPy and ONNX Runtime: no PyTorch, no library."""
    shutil.copy(onnx_runner.__file__, tmp_path)
    shutil.copy(exported, tmp_path / "policy.onnx")
    command = [sys.executable, "-c", ALONE]
    run = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert run.returncode == 0, run.stderr
    reason, *numbers = run.stdout.split()
    expected = step(
        PolicyRunner(load_policy(POLICIES / "polished_seed0"), lidar=LIDAR),
        0.0,
        human=None,
        stamp=0.0,
    )
    assert reason == "drive"
    expected = (expected.speed, expected.turn_rate)
    assert list(map(float, numbers)) == pytest.approx(expected, abs=1e-4)


def test_a_missing_runtime_is_named(exported, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(ImportError, match="OnnxRunner needs onnxruntime: pip install onnxruntime"):
        OnnxRunner(exported)


def test_infinite_commands_stop_the_robot(exported, tmp_path):
    onnx = pytest.importorskip("onnx")
    model = onnx.load(str(exported))
    (last,) = [one for one in model.graph.initializer if one.name.endswith("layers.8.bias")]
    last.raw_data = np.full(2, NAN, np.float32).tobytes()
    onnx.save(model, str(tmp_path / "nan.onnx"))
    command = step(OnnxRunner(tmp_path / "nan.onnx"))
    assert (command.reason, command.speed) == ("refused", 0.0)
    assert "the policy's command is not finite" in command.detail
