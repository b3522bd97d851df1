"""How the robot moves, and its last commands: the same numbers in training, policy, runner and ONNX file."""

from __future__ import annotations

import dataclasses
import json
import math

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from envs.policy_env import lidar_geometry, make_policy_env, sensing
from tests._any_robot import LIDAR, ROBOT, SENSING
from tests._restless import restless
from torchrl_morl.deploy import PolicyRunner, Sensing, export_onnx
from torchrl_morl.deploy.entries import Entries
from torchrl_morl.deploy.features import RowFeatures, observation
from torchrl_morl.deploy.onnx_runner import OnnxRunner
from torchrl_morl.deploy.sensing import NUM_MOTION
from torchrl_morl.preferences import PreferenceSpace
from torchrl_morl.transforms import PreferenceSampler

PREFERENCE = (0.2, 0.3, 0.5)
ALL = dataclasses.replace(SENSING, observe_motion=True)


@pytest.mark.parametrize("reads", [Sensing(observe_motion=True), ALL], ids=["one robot", "any"])
def test_a_row_has_the_features_of_its_parts(reads):
    draw = torch.Generator().manual_seed(0)
    parts = {
        "lidar": 4 * torch.rand(3, 30, generator=draw),
        "goal": torch.rand(3, 2, generator=draw),
        "human": torch.rand(3, 2, generator=draw),
    }
    if reads.observe_robot:
        parts["human_velocity"] = torch.rand(3, 2, generator=draw)
        parts["nobody"] = torch.zeros(3, 1)
        parts["robot"] = torch.tensor(ROBOT).expand(3, 6)
    parts["motion"] = torch.rand(3, NUM_MOTION, generator=draw)
    row = torch.cat((*parts.values(), torch.full((3, 3), 1 / 3)), -1)
    features = RowFeatures(reads, 3, like=row)(row)
    assert features.shape == (3, reads.observation_size + 3)
    torch.testing.assert_close(features[:, :-3], observation(reads, **parts))
    shares = features[:, -3 - NUM_MOTION : -3]
    scale = torch.tensor([1 / ROBOT[1], 1 / ROBOT[2]] * 5) if reads.observe_robot else 1.0
    torch.testing.assert_close(shares, parts["motion"] * scale)


def test_the_runner_drives_as_the_policy_in_its_environment():
    """Poses are all that the runner is given of motions, and its own commands all that it remembers."""
    arguments = {"scene": "static", "num_envs": 1, "seed": 3, "observe_motion": True}
    env = make_policy_env(
        PreferenceSampler(
            PreferenceSpace(("core", "demo", "distance", "efficiency"), static={"core": 1.0})
        ),
        keep_simulation=True,
        faults={"latency": 2, "lag": 0.1},
        **arguments,
    )
    policy = restless(sensing(arguments))
    runner = PolicyRunner(policy, lidar=lidar_geometry(env.base_env))
    data, moved = env.reset(), 0.0
    preference = torch.tensor([PREFERENCE])
    for step in range(40):
        data["preference"] = preference
        data = policy.actor(data)
        command = runner.step(
            data["scan"][0].numpy(),
            goal=data["goal"][0].tolist(),
            human=data["human"][0].tolist(),
            odometry=data["pose"][0].tolist(),
            preference=PREFERENCE,
            stamp=0.2 * step,
            time=0.2 * step + 0.01,
        )
        assert command.reason == "drive", command.detail
        expected = env.transform[0].inv(TensorDict(action=data["action"], batch_size=[1]))["action"]
        np.testing.assert_allclose(
            (command.speed, command.turn_rate), expected[0].numpy(), atol=2e-4
        )
        data = env.step(data)["next"]
        moved = max(moved, abs(data["motion"][0, :2]).max().item())
        if data["done"].any():
            break
    env.close()
    assert step > 5 and moved > 0.2


def test_the_onnx_file_drives_as_the_runner(tmp_path):
    pytest.importorskip("onnxscript")
    policy = restless(ALL)
    file = export_onnx(policy, tmp_path / "any.onnx", lidar=LIDAR, robot=ROBOT)
    theirs, ours = OnnxRunner(file), PolicyRunner(policy, lidar=LIDAR, robot=ROBOT)
    assert theirs.reads_motion and ours.reads_motion
    draw = np.random.default_rng(0)
    pose, commands = np.zeros(3), []
    for step in range(20):
        pose = pose + draw.normal(0.0, 0.05, 3)
        arguments = {
            "goal": (4.0, 0.3),
            "human": (2.0, -0.5),
            "odometry": tuple(pose),
            "preference": PREFERENCE,
            "stamp": 0.2 * step,
            "time": 0.2 * step + 0.01,
        }
        ranges = draw.uniform(0.3, 6.0, 180)
        one, other = ours.step(ranges, **arguments), theirs.step(ranges, **arguments)
        assert one.reason == other.reason == "drive", one.detail
        assert other.speed == pytest.approx(one.speed, abs=1e-5)
        assert other.turn_rate == pytest.approx(one.turn_rate, abs=1e-4)
        commands.append((one.speed, one.turn_rate))
    assert len(set(commands)) == len(commands)


class Recorder(PolicyRunner):
    """Keeps what the policy is given."""

    def _command(self, scan, inputs):
        self.motion = inputs["motion"]
        return 0.3, 0.1


def recorder() -> Recorder:
    return Recorder(restless(Sensing(observe_motion=True)), lidar=LIDAR)


def go(runner: PolicyRunner, time: float, pose, **changed):
    given = {"goal": (4.0, 0.0), "preference": PREFERENCE, "odometry": pose}
    return runner.step([3.0] * 180, **{**given, "stamp": time, "time": time + 0.01, **changed})


def test_what_a_runner_remembers():
    runner = recorder()
    go(runner, 0.0, (1.0, 1.0, 3.1))
    assert runner.motion == (0.0,) * NUM_MOTION
    # Half a metre a second ahead, and a turn over the seam of the circle.
    go(runner, 0.2, (0.9, 1.0, math.pi + 0.1 - 2 * math.pi))
    assert runner.motion[:4] == pytest.approx(
        (0.1 * math.cos(0.1) / 0.2, (math.pi + 0.1 - 3.1) / 0.2, 0.3, 0.1)
    )
    assert runner.motion[4:] == (0.0,) * 6
    # A stop is a command, too.
    assert go(runner, 0.4, (0.9, 1.0, 0.0), goal=None).reason == "no goal"
    go(runner, 0.6, (0.9, 1.0, 0.0))
    assert runner.motion[2:6] == (0.0, 0.0, 0.3, 0.1)
    # Whoever has told it nothing for long has let it stand.
    go(runner, 2.0, (5.0, 1.0, 0.0))
    assert runner.motion == (0.0,) * NUM_MOTION


JUMPS = [(1.8, 0.0, 0.0), (0.0, -5.0, 0.0), (1e30, 0.0, 0.0), (1.7e308, -1.7e308, 0.0)]
"""What odometry does where a robot is localised anew, x, y and heading, in a step of 0.2 s at 0.5 m/s."""


@pytest.mark.parametrize("jump", [*JUMPS, (0.0, 0.0, 2.0)])
def test_odometry_that_jumps_is_no_motion(jump):
    runner = recorder()
    go(runner, 0.0, (0.0, 0.0, 0.0))
    go(runner, 0.2, (0.1, 0.0, 0.0))
    assert runner.motion[0] == pytest.approx(0.5)
    there = np.add((0.2, 0.0, 0.0), jump)
    go(runner, 0.4, tuple(there))
    assert runner.motion[:2] == (0.0, 0.0) and runner.motion[2:4] == (0.3, 0.1)
    if jump[0] < 1e20:  # further away 0.1 m is no difference
        go(runner, 0.6, there + np.array((0.1 * math.cos(jump[2]), 0.1 * math.sin(jump[2]), 0.0)))
        assert runner.motion[0] == pytest.approx(0.5)


def test_the_fastest_that_it_may_have_moved():
    for way, found in ((0.29, 0.29 / 0.2), (0.31, 0.0)):  # 2 x 0.5 m/s x 0.2 s + 0.1 m
        runner = recorder()
        go(runner, 0.0, (0.0, 0.0, 0.0))
        go(runner, 0.2, (way, 0.0, 0.0))
        assert runner.motion[0] == pytest.approx(found)


@pytest.mark.parametrize("jump", [(0.4, 0.0, 0.0), *JUMPS])
def test_a_person_does_not_walk_where_odometry_jumps(jump):
    """0.4 m are 2 m/s of the person, who could walk so; the robot cannot."""
    runner = PolicyRunner(restless(ALL), lidar=LIDAR, robot=(ROBOT[0], 0.5, *ROBOT[2:]))
    given, seen = runner._command, []
    runner._command = lambda scan, inputs: seen.append(inputs) or given(scan, inputs)
    for time, x, y in ((0.0, 0.0, 0.0), (0.2, 0.0, 0.0), (0.4, *jump[:2])):
        command = go(runner, time, (x, y, 0.0), human=(2.0, 0.0))
        assert command.reason == "drive", command.detail
    assert seen[-1]["human_velocity"] == (0.0, 0.0)


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        (None, "this policy reads how the robot moves: give odometry="),
        ((0.0, 0.0), "odometry must be x, y and heading, got"),
        ((0.0, math.nan, 0.0), "odometry must be finite, got"),
    ],
)
def test_without_odometry_it_stands(pose, message):
    command = go(recorder(), 0.0, pose)
    assert (command.speed, command.turn_rate, command.reason) == (0.0, 0.0, "refused")
    assert message in command.detail


def test_act_says_what_is_missing():
    policy = restless(Sensing(observe_motion=True))
    given = {"preference": PREFERENCE, "lidar": [3.0] * 30, "goal": (4.0, 0.0)}
    with pytest.raises(ValueError, match="reads how the robot moves: give motion="):
        policy.act(**given)
    with pytest.raises(ValueError, match=r"motion must have shape \[\.\.\., 10\], got \[4\]"):
        policy.act(**given, motion=[0.0] * 4)
    with pytest.raises(ValueError, match="motion"):
        policy.act(**given, motion=[math.nan] * 10)
    with pytest.raises(ValueError, match="does not read motion="):
        restless(Sensing()).act(**given, motion=[0.0] * 10)
    backwards = policy.act(**given, motion=[-0.1] * 10)  # a wheel that slips, a turn to the right
    assert abs(backwards - policy.act(**given, motion=[0.0] * 10)).max() > 1e-4


def test_files_keep_it():
    for reads in (Sensing(), Sensing(observe_motion=True)):
        written = reads.to_json()
        assert ("observe_motion" in written) == reads.observe_motion
        assert Sensing.from_json(Entries(json.loads(json.dumps(written)), "sensing")) == reads
    with pytest.raises(ValueError, match="reads how the robot moves: observe_motion=True"):
        Sensing(observe_motion=True).check(Sensing())
