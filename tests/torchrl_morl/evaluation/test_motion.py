"""Standing, jerking and turning in closed form: a line, a circle, a standing robot."""

from __future__ import annotations

import math

import pytest
import torch

from torchrl_morl.evaluation import (
    cumulative_heading_change,
    mean_jerk,
    path_irregularity,
    stalled_time,
)

F64 = torch.float64
DT = 0.2


def line(points: int = 21, y: float = 0.0, step: float = 0.1) -> torch.Tensor:
    x = step * torch.arange(points, dtype=F64)
    return torch.stack((x, torch.full_like(x, y)), dim=-1)


def circle(radius: float = 2.0, points: int = 721) -> tuple[torch.Tensor, torch.Tensor]:
    """Once around the origin, counter-clockwise, and the heading, wrapped."""
    angle = torch.linspace(0, 2 * math.pi, points, dtype=F64)
    position = radius * torch.stack((angle.cos(), angle.sin()), dim=-1)
    heading = torch.remainder(angle + math.pi / 2 + math.pi, 2 * math.pi) - math.pi
    return position, heading


def whole(path: torch.Tensor) -> torch.Tensor:
    return torch.ones(path.shape[0], dtype=torch.bool)


# --- standing


def test_standing_robot_stalls_all_the_time():
    position = torch.zeros(51, 2)
    assert stalled_time(position, whole(position), DT).item() == pytest.approx(10.0)


def test_driving_robot_never_stalls():
    assert stalled_time(line(), whole(line()), DT) == 0
    slow = line(step=0.04 * DT)
    assert stalled_time(slow, whole(slow), DT).item() == pytest.approx(20 * DT)
    assert stalled_time(slow, whole(slow), DT, threshold=0.03) == 0


def test_only_the_pause_counts():
    path = torch.cat((line(6), line(6)[-1:].expand(7, 2), line(6) + line(6)[-1]))
    # Seven points on the spot of the sixth, and the first of the way on: eight steps.
    assert stalled_time(path, whole(path), DT).item() == pytest.approx(8 * DT)


# --- jerk


def test_constant_acceleration_has_no_jerk():
    time = DT * torch.arange(30, dtype=F64)
    position = torch.stack((0.5 * time**2, 1.0 + 0.3 * time), dim=-1)
    assert mean_jerk(position, whole(position), DT).item() == pytest.approx(0.0, abs=1e-9)


def test_cubic_has_constant_jerk():
    time = DT * torch.arange(30, dtype=F64)
    position = torch.stack((0.5 * time**3, -(time**3) / 3), dim=-1)
    assert mean_jerk(position, whole(position), DT).item() == pytest.approx(math.hypot(3, 2))


def test_jerk_on_a_circle():
    position, _ = circle(2.0, 361)
    rate = 2 * math.pi / (360 * DT)
    value = mean_jerk(position, whole(position), DT).item()
    assert value == pytest.approx(2.0 * (2 * math.sin(rate * DT / 2) / DT) ** 3)
    assert value == pytest.approx(2.0 * rate**3, rel=1e-4)


@pytest.mark.parametrize("points", [1, 2, 3, 4])
def test_jerk_needs_four_points(points):
    position = line(points)
    assert mean_jerk(position, whole(position), DT).isnan() == (points < 4)


# --- turning


def test_once_around_is_a_full_turn():
    _, heading = circle()
    value = cumulative_heading_change(heading, whole(heading))
    assert value.item() == pytest.approx(2 * math.pi)


def test_left_and_right_do_not_cancel():
    heading = torch.tensor([0.0, 0.5, 0.0, -0.5, 0.0], dtype=F64)
    assert cumulative_heading_change(heading, whole(heading)).item() == pytest.approx(2.0)


@pytest.mark.parametrize("y", [0.0, 5.0])
def test_straight_line_is_regular_wherever_it_lies(y):
    position, heading = line(y=y), torch.zeros(21, dtype=F64)
    goal = torch.tensor([3.0, y], dtype=F64)
    assert cumulative_heading_change(heading, whole(heading)) == 0
    assert path_irregularity(position, heading, whole(heading), goal).item() == 0


def test_turn_to_the_goal_is_needed():
    position = torch.cat((torch.zeros(4, 2, dtype=F64), -line()))
    heading = torch.full((25,), math.pi, dtype=F64)
    heading[:4] = torch.tensor([0.0, 1.0, 2.0, 3.0])
    goal = torch.tensor([-3.0, 0.0], dtype=F64)
    value = path_irregularity(position, heading, whole(heading), goal)
    assert value.item() == pytest.approx(0.0, abs=1e-12)
    # The other way round, it turns by one radian too much before it comes back.
    heading[:4] = torch.tensor([0.0, -1.0, 0.0, 1.5])
    value = path_irregularity(position, heading, whole(heading), goal)
    assert value.item() == pytest.approx(2.0 / 2.0)


def test_circle_that_was_not_asked_for():
    position, heading = circle(2.0)
    ahead = position[0] + torch.tensor([0.0, 4.0], dtype=F64)
    value = path_irregularity(position, heading, whole(heading), ahead)
    assert value.item() == pytest.approx(0.5, rel=1e-4)  # a full turn over 2 pi times its radius


def test_turning_less_than_to_the_goal_is_not_negative():
    position, heading = line(), torch.zeros(21, dtype=F64)
    goal = torch.tensor([0.0, 3.0], dtype=F64)
    assert path_irregularity(position, heading, whole(heading), goal) == 0


def test_irregularity_of_a_robot_that_never_moved_is_undefined():
    position, heading = torch.zeros(5, 2), torch.linspace(0, 2, 5)
    value = path_irregularity(position, heading, whole(heading), torch.tensor([3.0, 0.0]))
    assert value.isnan()
    assert cumulative_heading_change(heading, whole(heading)).item() == pytest.approx(2.0)
