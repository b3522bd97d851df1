"""A mark for nobody and which robot it is: the same numbers in training, policy, runner and ONNX file."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from tests._any_robot import LIDAR, ROBOT, SENSING, TOO_MUCH
from torchrl_morl.deploy import Limits, PolicyRunner, Sensing, export_onnx
from torchrl_morl.deploy.export import main
from torchrl_morl.deploy.features import observation, policy_transforms
from torchrl_morl.deploy.graph import PolicyGraph
from torchrl_morl.deploy.onnx_runner import OnnxRunner
from torchrl_morl.deploy.policy_files import save_policy
from torchrl_morl.testing import untrained_policy

PREFERENCE = (0.2, 0.3, 0.5)


@pytest.fixture(scope="module")
def policy():
    torch.manual_seed(1)
    return untrained_policy(sensing=SENSING)


def sensed(seed: int) -> dict[str, np.ndarray]:
    draw = np.random.default_rng(seed)
    return {
        "lidar": draw.uniform(0.3, 4.0, 30),
        "goal": draw.uniform((0.5, -3.0), (10.0, 3.0)),
        "human": draw.uniform((0.5, -3.0), (7.0, 3.0)),
        "human_velocity": draw.uniform(-1, 1, 2),
    }


def test_features_are_those_of_the_training(policy):
    given = sensed(0)
    transforms = policy_transforms(
        observe_human_velocity=True, observe_nobody=True, observe_robot=True
    )
    features = transforms[3:]  # behind the scaling of actions, the check and the sectors
    for human, marked in ((given["human"], 0.0), (SENSING.nobody, 1.0)):
        data = TensorDict(
            lidar=torch.tensor(given["lidar"]).float(),
            goal=torch.tensor(given["goal"]).float(),
            human=torch.tensor(human).float(),
            human_velocity=torch.zeros(2),
            pose=torch.zeros(3),
            human_pose=torch.zeros(3),
            robot=torch.tensor(ROBOT),
        )
        for transform in features:
            if type(transform).__name__ != "VelocityInFrame":
                data = transform._call(data)
        assert data["observation"][38].item() == marked
        row = policy._checked(
            {
                "lidar": given["lidar"],
                "goal": given["goal"],
                "human": human,
                "human_velocity": (0.0, 0.0),
                "nobody": (0.0,),
                "robot": ROBOT,
                "preference": PREFERENCE,
            },
            tensors=False,
        )
        policy._features.mark_nobody(row)
        observation = policy._features(row)[: SENSING.observation_size]
        torch.testing.assert_close(observation, data["observation"], atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("further", [8.0, 100.0])
def test_a_lidar_that_sees_further_than_scans_reads_as_one_that_sees_as_far(policy, further):
    def act(lidar_range):
        robot = (*ROBOT[:4], lidar_range, ROBOT[5])
        features = observation(
            SENSING,
            **{name: torch.tensor(value) for name, value in sensed(1).items()},
            nobody=torch.zeros(1),
            robot=torch.tensor(robot),
        )
        return features, policy.act(preference=PREFERENCE, robot=robot, **sensed(1))

    as_far = act(SENSING.max_range)
    for one, other in zip(act(further), as_far):
        np.testing.assert_array_equal(one, other)
    for one, other in zip(act(3.0), as_far):
        assert abs(one - other).max() > 1e-6


def test_nobody_is_what_is_reported_of_nobody(policy):
    given = sensed(1) | {"human_velocity": (0.0, 0.0)}
    del given["human"]
    left_out = policy.act(preference=PREFERENCE, robot=ROBOT, **given)
    reported = policy.act(preference=PREFERENCE, robot=ROBOT, human=SENSING.nobody, **given)
    near = policy.act(preference=PREFERENCE, robot=ROBOT, human=(3.99, math.pi), **given)
    np.testing.assert_array_equal(left_out, reported)
    assert abs(near - reported).max() > 1e-4


def test_commands_are_within_the_limits_of_the_robot(policy):
    robots = np.array([ROBOT, (0.15, 0.3, 1.0, 6.28, 4.0, 0.0)])
    command = policy.act(preference=PREFERENCE, robot=robots, **sensed(2))
    assert command.shape == (2, 2)
    assert (command[:, 0] >= 0).all() and (command[:, 0] <= robots[:, 1]).all()
    assert (abs(command[:, 1]) <= robots[:, 2]).all()


@pytest.mark.parametrize("somebody", [True, False])
def test_the_onnx_file_drives_as_the_runner(policy, tmp_path, somebody):
    pytest.importorskip("onnxscript")
    file = export_onnx(policy, tmp_path / "any.onnx", lidar=LIDAR, robot=ROBOT)
    theirs, ours = OnnxRunner(file), PolicyRunner(policy, lidar=LIDAR, robot=ROBOT)
    assert theirs.metadata["robot_numbers"] == pytest.approx(ROBOT)
    assert theirs.max_speed == ours.max_speed == ROBOT[1]
    assert theirs.max_turn_rate == ours.max_turn_rate == ROBOT[2]
    for step in range(20):
        given = sensed(10 + step)
        ranges = np.random.default_rng(step).uniform(0.3, 6.0, 180)
        arguments = {
            "goal": tuple(given["goal"]),
            "human": tuple(given["human"]) if somebody else None,
            "human_velocity": tuple(given["human_velocity"]) if somebody else None,
            "preference": PREFERENCE,
            "stamp": 0.2 * step,
            "time": 0.2 * step + 0.01,
        }
        one, other = ours.step(ranges, **arguments), theirs.step(ranges, **arguments)
        assert one.reason == other.reason == "drive", one.detail
        assert other.speed == pytest.approx(one.speed, abs=1e-5)
        assert other.turn_rate == pytest.approx(one.turn_rate, abs=1e-4)


def test_the_command_line_is_told_the_robot(policy, tmp_path, capsys):
    pytest.importorskip("onnxscript")
    save_policy(
        tmp_path / "policy",
        policy.actor,
        preference_space=policy.preference_space,
        sensing=SENSING,
        limits=policy.limits,
        period=policy.period,
        robot="any",
        card={},
    )
    arguments = [str(tmp_path / "policy"), "--onnx", str(tmp_path / "any.onnx")]
    with pytest.raises(SystemExit):
        main(arguments)
    assert "give robot=, its radius (m), top speed" in capsys.readouterr().err
    main([*arguments, "--robot", *map(str, ROBOT)])
    main(
        [
            str(tmp_path / "policy"),
            "--onnx",
            str(tmp_path / "base.onnx"),
            "--robot",
            "0.2",
            "0.5",
            "3",
        ]
    )
    assert OnnxRunner(tmp_path / "base.onnx").metadata["lidar"]["mount"] == [0.0, 0.0, 0.0]
    mount = OnnxRunner(tmp_path / "any.onnx").metadata["lidar"]["mount"]
    assert mount == pytest.approx([ROBOT[-1], 0.0, 0.0])


@pytest.mark.parametrize(
    ("sensing", "robot", "message"),
    [
        (SENSING, None, "this policy reads which robot it drives"),
        (
            SENSING,
            ROBOT[:5],
            "robot must be three numbers, radius, top speed and top turn rate, or six, got",
        ),
        (SENSING, (0.0, *ROBOT[1:]), "above 0, got"),
        (SENSING, (math.nan, *ROBOT[1:]), "robot must be finite, got"),
        *((SENSING, *one) for one in TOO_MUCH),
        (Sensing(), ROBOT, "this policy does not read robot="),
    ],
)
def test_robots_that_are_refused(sensing, robot, message):
    policy = untrained_policy(sensing=sensing)
    for make in (PolicyRunner, PolicyGraph):
        with pytest.raises(ValueError, match=message) as caught:
            make(policy, lidar=LIDAR, robot=robot)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("robot", "message"), TOO_MUCH)
def test_one_of_many_robots_is_refused(policy, robot, message):
    with pytest.raises(ValueError, match=message):
        policy.act(preference=PREFERENCE, robot=np.array([ROBOT, robot]), **sensed(2))


def test_one_robot_of_those_that_a_policy_drives():
    reads, limits = SENSING.of_robot(ROBOT), Limits.of_robot(*ROBOT[1:3])
    assert reads == dataclasses.replace(SENSING, lidar_origin=(ROBOT[-1], 0.0))
    assert limits == Limits((0.0, ROBOT[1]), (-ROBOT[2], ROBOT[2]))
    graph = PolicyGraph(untrained_policy(sensing=SENSING), lidar=LIDAR, robot=ROBOT)
    assert (graph.sensing, graph.limits) == (reads, limits)
    with pytest.raises(ValueError, match=r"limits: speed must be two finite .* \(0\.0, 0\.0\)"):
        Limits.of_robot(0.0, 1.0)
