"""ONNX files: the policy's commands, what they tell of themselves, and what is refused before a file is there."""

from __future__ import annotations

import copy
import dataclasses
import hashlib
import json
import sys
import types
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.parity import act
from torchrl_morl.deploy import (
    LidarGeometry,
    Sensing,
    export_onnx,
    load_policy,
    onnx_export,
)
from torchrl_morl.deploy.export import main
from torchrl_morl.testing import sensor_readings, untrained_policy

from ._stops import LIDAR

POLICIES = Path(__file__).parents[3] / "recipes" / "policies"
OFF_CENTRE = LidarGeometry(-2.3, np.pi / 90, 133, 0.1, 10.0, (0.1, -0.05, 0.3))

onnx = pytest.importorskip("onnx")
onnxruntime = pytest.importorskip("onnxruntime")
pytest.importorskip("onnxscript")


def run(file: Path, readings: dict[str, np.ndarray]) -> np.ndarray:
    session = onnxruntime.InferenceSession(str(file), providers=["CPUExecutionProvider"])
    (command,) = session.run(None, readings)
    return command


@pytest.mark.parametrize("batch", [1, 7, 500])
def test_commands_are_those_of_the_policy_in_a_batch_of_any_size(exported, batch):
    policy = load_policy(POLICIES / "polished_seed0")
    readings = sensor_readings(policy, LIDAR, batch, seed=batch)
    found = run(exported, readings)
    assert found.shape == (batch, 2)
    difference = abs(found - act(policy, LIDAR)(readings)).max(0)
    assert difference[0] < 1e-5 and difference[1] < 1e-4
    assert batch == 1 or np.ptp(found, axis=0).min() > 0.1  # the inputs do command different things


def test_a_policy_that_reads_velocities(policy_folders, exported_walking):
    policy = load_policy(policy_folders["walking"])
    readings = sensor_readings(policy, LIDAR, 100)
    found = run(exported_walking, readings)
    np.testing.assert_allclose(found, act(policy, LIDAR)(readings), atol=1e-4)
    readings["human_velocity"] = -readings["human_velocity"]
    assert abs(run(exported_walking, readings) - found).max() > 1e-2


def test_a_lidar_off_the_centre_and_no_human(tmp_path):
    policy = untrained_policy(sensing=Sensing(observe_human=False, unknown_range=2.5))
    file = export_onnx(policy, tmp_path / "mine.onnx", lidar=OFF_CENTRE)
    readings = sensor_readings(policy, OFF_CENTRE, 200)
    assert readings.keys() == {"ranges", "goal", "preference"}
    expected = act(policy, OFF_CENTRE)(readings)
    np.testing.assert_allclose(run(file, readings), expected, atol=1e-5)


def test_the_file_is_one_file_of_standard_operators(exported):
    model = onnx.load(str(exported))
    onnx.checker.check_model(model, full_check=True)
    assert {node.domain for node in model.graph.node} == {""}
    assert [(one.domain, one.version) for one in model.opset_import] == [("", 18)]
    inputs = {one.name: one.type.tensor_type for one in model.graph.input}
    assert list(inputs) == ["ranges", "goal", "human", "preference"]
    for tensor in inputs.values():
        assert tensor.elem_type == onnx.TensorProto.FLOAT
        assert tensor.shape.dim[0].dim_param == "batch"
    assert [one.name for one in model.graph.output] == ["command"]
    assert list(exported.parent.iterdir()) == [exported]


def test_what_it_tells_of_itself(exported):
    model = onnx.load(str(exported))
    told = {one.key: json.loads(one.value) for one in model.metadata_props}
    folder = POLICIES / "polished_seed0"
    config = json.loads((folder / "policy.json").read_text())
    assert told["torchrl_morl_format"] == 1
    for name in ("objectives", "static", "sensing", "limits", "period", "robot", "card"):
        assert told[name] == config[name], name
    assert told["preference"] == ["demo", "distance", "efficiency"]
    assert told["lidar"] == {**dataclasses.asdict(LIDAR), "mount": [0.0, 0.0, 0.0]}
    weights = (folder / "policy.safetensors").read_bytes()
    assert told["weights_sha256"] == hashlib.sha256(weights).hexdigest()
    assert told["inputs"]["goal"] == {"entries": ["distance", "bearing"], "unit": ["m", "rad"]}
    assert told["inputs"].keys() == {one.name for one in model.graph.input}
    assert told["outputs"]["command"]["unit"] == ["m/s", "rad/s"]


def test_it_tells_nothing_of_the_machine_that_wrote_it(exported):
    data = exported.read_bytes()
    for path in (Path(__file__).parents[3], Path(torch.__file__).parent):
        assert str(path).encode() not in data


def test_what_exists_stays(exported):
    data = exported.read_bytes()
    with pytest.raises(FileExistsError, match="exists and is not overwritten: choose another name"):
        export_onnx(untrained_policy(), exported, lidar=LIDAR)
    assert exported.read_bytes() == data


def test_a_file_that_computes_something_else_is_not_written(exported, tmp_path, monkeypatch):
    """The exporter answers with the network of another policy: the comparison notices."""
    program = types.SimpleNamespace(model_proto=onnx.load(str(exported)))
    monkeypatch.setattr(torch.onnx, "export", lambda *args, **kwargs: program)
    with pytest.raises(ValueError, match="would not compute what the policy does: commands differ"):
        export_onnx(untrained_policy(), tmp_path / "wrong.onnx", lidar=LIDAR)
    assert list(tmp_path.iterdir()) == []


def float64(policy):
    return dataclasses.replace(policy, actor=copy.deepcopy(policy.actor).double())


@pytest.mark.parametrize(
    ("policy", "file", "lidar", "error", "message"),
    [
        (untrained_policy, "none/a.onnx", LIDAR, FileNotFoundError, "there is no folder"),
        (lambda: None, "a.onnx", LIDAR, ValueError, "policy must be a Policy, from load_policy"),
        (untrained_policy, "a.onnx", None, ValueError, "lidar must be a LidarGeometry, got None"),
        (
            lambda: dataclasses.replace(untrained_policy(), sensing=None),
            "a.onnx",
            LIDAR,
            ValueError,
            "does not tell what it senses",
        ),
        (
            lambda: float64(untrained_policy()),
            "a.onnx",
            LIDAR,
            ValueError,
            r"has float32 weights, this policy has torch\.float64",
        ),
        (
            untrained_policy,
            "a.onnx",
            LidarGeometry(0.0, 0.5, 10, 0.1, 4.0),
            ValueError,
            r"lidar: beams every 28\.6 degrees",
        ),
    ],
)
def test_what_is_refused(tmp_path, policy, file, lidar, error, message):
    with pytest.raises(error, match=message) as found:
        export_onnx(policy(), tmp_path / file, lidar=lidar)
    assert len(str(found.value).splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_a_missing_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxscript", None)
    expected = r"export_onnx needs onnxscript: pip install 'torchrl-morl\[export\]'"
    with pytest.raises(ImportError, match=expected):
        export_onnx(untrained_policy(), tmp_path / "a.onnx", lidar=LIDAR)


# --- the command --------------------------------------------------------------------------------


def test_the_command_writes_the_file_and_the_runner(tmp_path, capsys, monkeypatch):
    given: list[tuple] = []

    def export(policy, file, *, lidar, robot):
        assert robot is None
        given.append((policy.robot, lidar))
        file.write_bytes(b"onnx")

    monkeypatch.setattr("torchrl_morl.deploy.export.export_onnx", export)
    file, runner = tmp_path / "a.onnx", tmp_path / "onnx_runner.py"
    lidar = ["--lidar", "-3.1416", "0.017453", "360", "0.12", "3.5", "--mount", "0.05", "0", "-0.1"]
    main([str(POLICIES / "polished_seed0"), "--onnx", str(file), "--runner", str(runner), *lidar])
    mount = (0.05, 0.0, -0.1)
    assert given == [("turtlebot2", LidarGeometry(-3.1416, 0.017453, 360, 0.12, 3.5, mount))]
    source = Path(onnx_export.__file__).with_name("onnx_runner.py")
    assert runner.read_bytes() == source.read_bytes()
    printed = capsys.readouterr().out
    assert "360 beams from -3.1416 to 3.1240 rad" in printed
    assert "preference: demo, distance, efficiency; a step every 0.2 s" in printed


POLISHED = str(POLICIES / "polished_seed0")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere", "--onnx", "a.onnx"], "a policy is a folder with"),
        ([POLISHED], "the following arguments are required: --onnx"),
        ([POLISHED, "--onnx", "no/a.onnx"], "there is no folder no: make it first"),
        ([POLISHED, "--onnx", "a.onnx", "--mount", "0", "0", "0"], "give --lidar as well"),
        (
            [POLISHED, "--onnx", "a.onnx", "--lidar", "0", "x", "360", "0.1", "3"],
            "--lidar 0 x 360 0.1 3: must be numbers, and NUM_BEAMS a whole one",
        ),
        (
            [POLISHED, "--onnx", "a.onnx", "--lidar", "0", "1", "360", "0.1", "3"],
            "--lidar 0 1 360 0.1 3: 360 beams every 1 rad are more than a revolution",
        ),
        (
            [POLISHED, "--onnx", "a.onnx", "--lidar", "0", "0.01", "36", "4", "3"],
            "range_min must be between 0 and range_max, 3, got 4.0",
        ),
        ([POLISHED, "--onnx", "a.onnx", "--runner", "a.onnx"], "is the file of --onnx"),
        ([POLISHED, "--onnx", "a.onnx", "--runner", "there.py"], "exists and is not overwritten"),
        ([POLISHED, "--onnx", "a.onnx", "--runner", "no/r.py"], "there is no folder no"),
        ([POLISHED, "--onnx", "there.py"], "exists and is not overwritten"),
    ],
)
def test_mistakes_of_the_command_are_one_line(tmp_path, capsys, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there.py").write_text("mine")
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("export: error: ") and message in line
    assert [path.name for path in tmp_path.iterdir()] == ["there.py"]
