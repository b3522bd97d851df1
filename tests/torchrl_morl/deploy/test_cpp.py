"""The C++ header, compiled: the runner's commands and stops, its example, and files that it refuses."""

from __future__ import annotations

import hashlib
import json
import math
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from torchrl.data import Bounded

from benchmarks.cpp_library import SOURCES, CppRunner, build, compiler
from torchrl_morl.deploy import LidarGeometry, PolicyRunner, load_policy, save_policy
from torchrl_morl.deploy.networks import ACTIVATIONS
from torchrl_morl.modules import make_actor
from torchrl_morl.preferences import PreferenceSpace
from torchrl_morl.testing import untrained_policy

from ._alike import LIMITS, check_limits, check_velocities, drive
from ._stops import LIDAR, STOPS, step

ROOT = Path(__file__).parents[3]
POLICIES = ROOT / "recipes" / "policies"
POLISHED = POLICIES / "polished_seed0"
LIDARS = {
    "ahead": LIDAR,
    "clockwise": LidarGeometry(2.35, -math.pi / 360, 541, 0.1, 10.0),
    "off the centre": LidarGeometry(-2.3, math.pi / 360, 541, 0.1, 10.0, (0.1, -0.05, 0.3)),
}

pytestmark = pytest.mark.skipif(
    compiler() is None, reason="there is no C++ compiler: install g++ or clang++"
)


@pytest.fixture
def runner(cpp_library) -> Iterator[CppRunner]:
    made = CppRunner(cpp_library, POLISHED, lidar=LIDAR)
    yield made
    made.close()


@pytest.mark.parametrize("lidar", LIDARS.values(), ids=LIDARS)
@pytest.mark.parametrize("name", ["polished_seed0", "walking", "hsr"])
def test_its_commands_are_those_of_the_runner(cpp_library, policy_folders, name, lidar):
    folder = policy_folders[name]
    ours = PolicyRunner(load_policy(folder), lidar=lidar)
    drive(ours, CppRunner(cpp_library, folder, lidar=lidar), lidar, 200)


def can_be_given_in_c(name: str, value: object) -> bool:
    """Whether it is numbers, as many as the argument has; a pointer that is null is ``None``."""
    if value is None:
        return name not in ("stamp", "time")
    sizes = {"goal": (2,), "human": (2,), "stamp": (), "time": ()}
    array = np.asarray(value)
    return array.dtype.kind in "fi" and sizes.get(name, array.shape) == array.shape


GIVEN_IN_C = [
    (changes, reason)
    for changes, reason, _ in STOPS
    if all(can_be_given_in_c(*change) for change in changes.items())
]


@pytest.mark.parametrize(("changes", "reason"), GIVEN_IN_C)
def test_it_stops_for_the_same_reasons(runner, changes, reason):
    command = step(runner, **changes)
    assert (command.speed, command.turn_rate, command.reason) == (0.0, 0.0, reason)
    assert command.detail and len(command.detail.splitlines()) == 1
    assert step(runner, 10.4).reason == "drive"


def test_most_stops_can_be_given_in_c():
    assert {reason for _, reason in GIVEN_IN_C} == {reason for _, reason, _ in STOPS}
    assert len(GIVEN_IN_C) > 20


def test_a_frozen_clock_stops_the_robot(runner):
    assert step(runner, 10.0).reason == "drive"
    assert step(runner, 10.0).reason == "clock"
    assert step(runner, 9.0).reason == "clock"
    assert step(runner, 9.2).reason == "drive"


def test_velocities_come_from_odometry(cpp_library, policy_folders):
    folder = policy_folders["walking"]
    other = CppRunner(cpp_library, folder, lidar=LIDAR)
    check_velocities(PolicyRunner(load_policy(folder), lidar=LIDAR), other)
    bad = step(other, 30.0, odometry=(math.nan, 0.0, 0.0))
    assert bad.reason == "refused" and "odometry must be finite" in bad.detail


@pytest.mark.parametrize("limits", LIMITS)
def test_limits_of_ones_own(cpp_library, limits):
    ours = PolicyRunner(load_policy(POLISHED), lidar=LIDAR, **limits)
    check_limits(ours, CppRunner(cpp_library, POLISHED, lidar=LIDAR, **limits))


@pytest.mark.parametrize("activation", ACTIVATIONS.values(), ids=ACTIVATIONS)
def test_every_activation_of_a_file(cpp_library, tmp_path, activation):
    torch.manual_seed(0)
    space, sensing = PreferenceSpace(("speed", "comfort")), untrained_policy().sensing
    actor = make_actor(
        Bounded(-1.0, 1.0, shape=(2,)),
        in_features=sensing.observation_size + 2,
        num_cells=(12, 9),
        activation_class=activation,
        last_layer_gain=5.0,
    )
    given = {"preference_space": space, "sensing": sensing, "robot": "mine", "card": {}}
    folder = save_policy(tmp_path / "policy", actor, **given)
    ours = PolicyRunner(load_policy(folder), lidar=LIDAR)
    other = CppRunner(cpp_library, folder, lidar=LIDAR)
    commands = drive(ours, other, LIDAR, 20, turn_rate=1e-5)
    assert np.ptp([command.turn_rate for command in commands]) > 0.05


# --- files ----------------------------------------------------------------------------------------


def changed(folder: Path, **entries: object) -> None:
    file = folder / "policy.json"
    config = json.loads(file.read_text())
    config.update(entries)
    file.write_text(json.dumps(config))


def spoil_weights(folder: Path) -> None:
    file = folder / "policy.safetensors"
    data = bytearray(file.read_bytes())
    data[-1] ^= 1
    file.write_bytes(bytes(data))


def replace_weights(data: bytes):
    """With a checksum that fits them."""

    def change(folder: Path) -> None:
        (folder / "policy.safetensors").write_bytes(data)
        changed(folder, checksum=hashlib.sha256(data).hexdigest())

    return change


def header(text: str) -> bytes:
    return len(text).to_bytes(8, "little") + text.encode()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda folder: (folder / "policy.json").unlink(), "policy.json: not found"),
        (lambda folder: (folder / "policy.safetensors").unlink(), "safetensors: not found"),
        (lambda folder: (folder / "policy.json").write_text("{"), "is not valid JSON at byte 1"),
        (lambda folder: (folder / "policy.json").write_text('{"a": NaN}'), "at byte 6"),
        (lambda folder: (folder / "policy.json").write_text("[" * 10**5), "nested too deeply"),
        (lambda folder: (folder / "policy.json").write_text("[]"), "lacks 'format'"),
        (
            lambda folder: (folder / "policy.json").write_text('{"a": 1, "b": {"c": 1, "c": 2}}'),
            "'c' stands there twice",
        ),
        (
            lambda folder: (folder / "policy.json").write_text(r'{"\u00e4": 1, "\u00f6": 2}'),
            "lacks 'format'",
        ),
        (lambda folder: changed(folder, format=1), "has format 1, this reads 2"),
        (lambda folder: changed(folder, sensing=None), "does not tell what the policy senses"),
        (lambda folder: changed(folder, period="fast"), "period must be a finite number"),
        (lambda folder: changed(folder, period=0), "must be positive"),
        (lambda folder: changed(folder, limits={"speed": [0]}), "speed must be 2 finite numbers"),
        (
            lambda folder: changed(folder, limits={"speed": [1, 0], "turn_rate": [-1, 1]}),
            "limits must be in ascending order",
        ),
        (lambda folder: changed(folder, objectives=["a", "b"]), "does not fit policy.json"),
        (spoil_weights, "is not the file that policy.json was written with"),
        (replace_weights(b"1"), "too short"),
        (replace_weights(b"\xff" * 100), "its header is longer than it is"),
        (replace_weights(header("{}")), "lacks the tensors of module.0.module.0"),
        (
            replace_weights(header('{"a":{"dtype":"F16","shape":[1],"data_offsets":[0,2]}}')),
            "a is F16: this reads float32",
        ),
        (
            replace_weights(header('{"a":{"dtype":"F32","shape":[9],"data_offsets":[0,36]}}')),
            "a has offsets that do not fit its shape and the file",
        ),
        (
            replace_weights(header('{"a":{"dtype":"F32","shape":[-1],"data_offsets":[0,4]}}')),
            "a has a broken shape",
        ),
        (
            replace_weights(
                header('{"a":{"dtype":"F32","shape":[1],"data_offsets":[0,4]}}') + b"\0\0\xc0\x7f"
            ),
            "a is not finite",
        ),
    ],
)
def test_files_that_are_refused(cpp_library, tmp_path, change, message):
    folder = tmp_path / "policy"
    shutil.copytree(POLISHED, folder)
    change(folder)
    with pytest.raises(ValueError, match=message.replace("(", r"\(")) as found:
        CppRunner(cpp_library, folder, lidar=LIDAR)
    assert len(str(found.value).splitlines()) == 1


@pytest.mark.parametrize(
    ("lidar", "options", "message"),
    [
        (LidarGeometry(0.0, 0.5, 10, 0.1, 4.0), {}, "at least 30 a revolution"),
        (LIDAR, {"max_speed": -1.0}, "max_speed must be finite and positive, got -1"),
        (LIDAR, {"timeout": math.inf}, "timeout must be finite and positive, got inf"),
    ],
)
def test_arguments_that_are_refused(cpp_library, lidar, options, message):
    with pytest.raises(ValueError, match=message):
        CppRunner(cpp_library, POLISHED, lidar=lidar, **options)


# --- the example ----------------------------------------------------------------------------------


def test_the_example_drives_to_its_goal_and_names_mistakes(tmp_path):
    program = build("drive.cpp", tmp_path / "drive")

    def drive(*arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [str(program), *arguments], capture_output=True, text=True, timeout=60
        )

    paths = {}
    for name in ("polished_seed0", "navigation"):
        for preference in ("0 1 0", "0 0 1"):
            run = drive(str(POLICIES / name), *preference.split())
            assert run.returncode == 0 and "goal reached" in run.stdout, run.stdout
            paths[name, preference] = run.stdout
    assert paths["polished_seed0", "0 1 0"] != paths["polished_seed0", "0 0 1"]
    assert "preference must have 3 entries, got 2" in drive(str(POLISHED), "1", "0").stdout
    for weight in ("0.5x", "half", ""):
        wrong = drive(str(POLISHED), "0", "0.5", weight)
        assert wrong.returncode == 2
        assert wrong.stderr == f"drive: error: WEIGHT must be a number, got '{weight}'\n"
    mistake = drive(str(ROOT))
    assert mistake.returncode == 2
    assert mistake.stderr.startswith("drive: error: ") and mistake.stderr.count("\n") == 1
    assert drive().stderr.startswith("usage: drive POLICY WEIGHT")


def test_the_program_of_the_page_commands_what_the_runner_does(tmp_path):
    page = (ROOT / "docs" / "how_to" / "export.md").read_text()
    (block,) = [code.split("```")[0] for code in page.split("```cpp\n")[1:]]
    (tmp_path / "page.cpp").write_text(block)
    program = build(str(tmp_path / "page.cpp"), tmp_path / "page", f"-I{SOURCES}")
    run = subprocess.run([str(program)], cwd=ROOT, capture_output=True, text=True, timeout=60)
    lidar = LidarGeometry(-math.pi, math.pi / 180, 360, 0.12, 3.5, mount=(0.05, 0.0, 0.0))
    expected = PolicyRunner(load_policy(POLISHED), lidar=lidar).step(
        np.full(360, 2.0),
        goal=(6.0, 0.3),
        human=(2.5, -0.4),
        preference=(0.2, 0.5, 0.3),
        stamp=0.0,
        time=0.0,
    )
    shown = f"{expected.speed:.3f} m/s, {expected.turn_rate:.3f} rad/s, drive\n"
    assert run.stdout == shown
