"""Recordings at the control period: resampling, headings and velocities."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from envs.demonstrations.feasibility import Tolerances, check
from envs.demonstrations.timed_path import heading_from_motion, velocities
from tests._recordings import line
from torchrl_morl.geometry import wrap_angle


def test_irregular_times_keep_the_velocity():
    rng = np.random.default_rng(0)
    time = np.cumsum(rng.uniform(0.01, 0.3, 100))
    path, reasons = check(line(0.4, time))
    assert reasons == []
    speed, turn, slip = velocities(path.pose[:-1], path.pose[1:])
    assert torch.allclose(speed, torch.full_like(speed, 0.4))
    assert torch.allclose(turn, torch.zeros_like(turn))
    assert torch.allclose(slip, torch.zeros_like(slip), atol=1e-12)
    assert torch.allclose(path.time.diff(), torch.full_like(speed, 0.2))


def test_headings_take_the_shortest_way():
    # Turning in place through pi, a tenth of a radian at 3.3 Hz, written within (-pi, pi].
    time = np.arange(0.0, 10.0, 0.3)
    turning = math.pi - 0.5 + np.minimum(0.3 * time, 1.0)
    wrapped = np.angle(np.exp(1j * turning))
    assert wrapped.min() < -2 < 2 < wrapped.max()
    recording = line(0.0, time, heading=wrapped)
    recording.position[:, 0] = np.linspace(0, -4, len(time))
    recording.goal[:, 0] = -4
    path, _ = check(recording, tolerances=Tolerances(slip=1.0))
    expected = np.interp(path.time.numpy(), time, turning)
    error = wrap_angle(path.pose[:, 2] - torch.from_numpy(expected))
    assert error.abs().max() < 1e-9


def test_an_episode_ends_at_the_goal():
    time = np.arange(0.0, 30.0, 0.2)
    path, _ = check(line(0.4, time), goal_radius=0.3)
    distance = (path.pose[:, :2] - path.goal).norm(dim=-1)
    assert distance[-1] <= 0.3 < distance[-2]


# --- velocities ----------------------------------------------------------------------------------


@pytest.mark.parametrize("turn", [-3.0, -0.5, 0.0, 1e-9, 0.7, math.pi])
def test_arcs_are_inverted_exactly(turn):
    start = torch.tensor([[1.0, -2.0, 3.0], [0.0, 0.0, -0.4]], dtype=torch.float64)
    speed, angle = 0.45, 0.2 * turn
    # Closed form of constant speeds: forward and left in the frame of the start.
    forward = speed * 0.2 if abs(turn) < 1e-6 else speed / turn * math.sin(angle)
    left = 0.0 if abs(turn) < 1e-6 else speed / turn * (1 - math.cos(angle))
    cos, sin = start[:, 2].cos(), start[:, 2].sin()
    end = torch.stack(
        (
            start[:, 0] + forward * cos - left * sin,
            start[:, 1] + forward * sin + left * cos,
            wrap_angle(start[:, 2] + angle),
        ),
        dim=-1,
    )
    for value, expected in zip(velocities(start, end), (speed, turn, 0.0)):
        torch.testing.assert_close(value, torch.full_like(value, expected), rtol=0, atol=1e-8)


def test_slip_is_signed_and_apart_from_the_speed():
    sideways = torch.tensor([0.0, 0.02, 0.0], dtype=torch.float64)
    speed, turn, slip = velocities(torch.zeros(3, dtype=torch.float64), sideways)
    assert (speed.item(), turn.item(), slip.item()) == pytest.approx((0.0, 0.0, 0.1))


# --- headings from motion ------------------------------------------------------------------------


def test_derived_headings_on_an_arc_are_exact_also_across_pi():
    angle = torch.linspace(-0.3, 4.0, 60, dtype=torch.float64)
    circle = torch.stack((angle.sin(), -angle.cos()), dim=-1)
    error = wrap_angle(heading_from_motion(circle) - angle)
    assert error.abs().max() < 1e-9


def test_a_robot_that_stands_keeps_its_derived_heading():
    x = torch.tensor([0.0, 0.0, 0.1, 0.2, 0.2, 0.2, 0.3])
    position = torch.stack((x, -x), dim=-1)
    assert torch.allclose(heading_from_motion(position), torch.full((7,), -math.pi / 4))
    assert heading_from_motion(torch.zeros(5, 2)) is None
