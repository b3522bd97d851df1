"""The lidars of benchmarks.lidars: what a policy is told, and that the native one changes nothing."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

from benchmarks.lidars import CASES, drive, told
from envs import TURTLEBOT2
from torchrl_morl.deploy import load_policy

pytestmark = pytest.mark.benchmark
POLICIES = Path(__file__).parents[2] / "recipes" / "policies"
ROWS = {case.name: case for case in CASES}
STEPS = 25


@pytest.fixture(scope="module", params=["navigation", "polished_seed0"])
def policy(request):
    return load_policy(POLICIES / request.param)


@pytest.mark.parametrize("name", ["native: 720 beams", "720 beams, clockwise"])
def test_the_beams_of_the_training_are_the_commands_of_the_training(policy, name):
    found = drove(policy, name)
    assert (found["difference"] < 1e-3).all()


def test_other_beams_are_other_commands(policy):
    assert drove(policy, "90 beams")["difference"].min() > 1e-3


def drove(policy, name):
    case = dataclasses.replace(ROWS[name], max_steps=STEPS)
    preference = np.full(3, 1 / 3)
    return drive(case, policy, preference, episodes=2, seed=7)


@pytest.mark.parametrize(
    ("name", "lidar"),
    [
        ("native: 720 beams", (2 * math.pi, 4.0, 0.0)),
        ("541 beams over 270 degrees, clockwise", (math.radians(270), 4.0, 0.0)),
        ("360 beams, range_max 3.5 m", (2 * math.pi, 3.5, 0.0)),
        ("mounted 0.1 m ahead", (2 * math.pi, 4.0, 0.1)),
    ],
)
def test_a_policy_is_told_the_lidar_of_the_row(name, lidar):
    policy = load_policy(POLICIES / "navigation")
    numbers = told(policy, ROWS[name], TURTLEBOT2)
    assert numbers == pytest.approx((0.177, 0.5, math.pi, *lidar))


def test_a_policy_that_reads_no_robot_is_told_none():
    policy = load_policy(POLICIES / "polished_seed0")
    assert told(policy, CASES[0], TURTLEBOT2) is None
