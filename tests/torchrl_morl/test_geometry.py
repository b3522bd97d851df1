"""Planar distances: hand-made cases, and random boxes against a brute-force oracle."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from envs.geometry import arctan2, cos_sin, norm
from torchrl_morl.geometry import (
    box_box_distance,
    box_corners,
    point_box_distance,
    rotate,
    segment_box_distance,
    wrap_angle,
)

F64 = {"dtype": torch.float64}


def _random_boxes(n: int, spread: float = 2.0) -> torch.Tensor:
    unit = torch.rand(n, 5, **F64)
    centre = spread * (2 * unit[:, :2] - 1)
    yaw = math.pi * (2 * unit[:, 2:3] - 1)
    return torch.cat((centre, yaw, 0.1 + unit[:, 3:]), dim=-1)


def _grid(box: np.ndarray, per_side: int) -> tuple[np.ndarray, float]:
    """Points covering a filled box, and the largest distance of its points from the nearest."""
    x, y, yaw, half_length, half_width = box
    u, v = np.meshgrid(np.linspace(-1, 1, per_side), np.linspace(-1, 1, per_side))
    local = np.stack((half_length * u.ravel(), half_width * v.ravel()), axis=-1)
    turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    reach = np.hypot(half_length, half_width) / (per_side - 1)
    return local @ turn + (x, y), reach


def _signed_distance_oracle(points: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Distance to the four edges one by one, negative where all four half-planes contain the point."""
    corners = box_corners(torch.as_tensor(box)).numpy()
    distance, inside = np.full(len(points), np.inf), np.ones(len(points), dtype=bool)
    for first, second in zip(corners, np.roll(corners, -1, axis=0)):
        edge = second - first
        along = np.clip((points - first) @ edge / (edge @ edge), 0, 1)
        distance = np.minimum(
            distance, np.linalg.norm(points - first - along[:, None] * edge, axis=1)
        )
        # Corners run clockwise: the inside lies to the right of each edge.
        relative = points - first
        inside &= edge[0] * relative[:, 1] - edge[1] * relative[:, 0] <= 0
    return np.where(inside, -distance, distance)


@pytest.mark.parametrize(
    ("vector", "angle", "expected"),
    [
        ((1.0, 0.0), math.pi / 2, (0.0, 1.0)),
        ((0.0, 2.0), math.pi / 2, (-2.0, 0.0)),
        ((3.0, 4.0), math.pi, (-3.0, -4.0)),
        ((1.0, 1.0), -math.pi / 4, (math.sqrt(2), 0.0)),
    ],
)
def test_rotation_is_counter_clockwise(vector, angle, expected):
    result = rotate(torch.tensor(vector, **F64), torch.tensor(angle, **F64))
    torch.testing.assert_close(result, torch.tensor(expected, **F64))


@pytest.mark.parametrize(
    ("angle", "expected"),
    [
        (0.0, 0.0),
        (math.pi, math.pi),
        (-math.pi, math.pi),
        (math.pi + 0.5, 0.5 - math.pi),
        (-math.pi - 0.5, math.pi - 0.5),
        (7 * math.pi, math.pi),
        (-20.0, -20.0 + 6 * math.pi),
    ],
)
def test_wrapped_angles(angle, expected):
    wrapped = wrap_angle(torch.tensor(angle, **F64))
    torch.testing.assert_close(wrapped, torch.tensor(expected, **F64), rtol=0, atol=1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_wrapping_stays_within_the_half_open_interval_and_keeps_the_direction(dtype):
    angle = torch.linspace(-30.0, 30.0, 10_001, dtype=dtype)
    wrapped = wrap_angle(angle)
    limit = torch.tensor(math.pi, dtype=dtype)
    assert (wrapped > -limit).all() and (wrapped <= limit).all()
    torch.testing.assert_close(wrapped.sin(), angle.sin(), rtol=0, atol=2e-5)
    torch.testing.assert_close(wrapped.cos(), angle.cos(), rtol=0, atol=2e-5)


@pytest.mark.parametrize(
    ("point", "expected"),
    [
        ((3.0, 0.0), 2.0),  # beside an edge
        ((4.0, 4.5), 5.0),  # off a corner: a 3-4-5 triangle
        ((1.0, 0.5), 0.0),  # on a corner
        ((1.0, 0.0), 0.0),  # on an edge
        ((0.0, 0.0), -0.5),  # the centre, half the width deep
        ((0.9, 0.0), -0.1),
    ],
)
def test_point_to_an_axis_aligned_box(point, expected):
    box = torch.tensor([0.0, 0.0, 0.0, 1.0, 0.5], **F64)
    distance = point_box_distance(torch.tensor(point, **F64), box)
    torch.testing.assert_close(distance, torch.tensor(expected, **F64))


def test_point_to_a_turned_and_shifted_box():
    # A square of half side 1 standing on a corner reaches sqrt(2) along the x axis.
    box = torch.tensor([5.0, -2.0, math.pi / 4, 1.0, 1.0], **F64)
    points = torch.tensor([[8.0, -2.0], [6.0, -1.0], [5.0, -2.0]], **F64)
    expected = torch.tensor([3 - math.sqrt(2), math.sqrt(2) - 1, -1.0], **F64)
    torch.testing.assert_close(point_box_distance(points, box), expected)


def test_points_against_the_edges_one_by_one():
    points = 4 * torch.rand(500, 2, **F64) - 2
    for box in _random_boxes(20, spread=1.0):
        expected = _signed_distance_oracle(points.numpy(), box.numpy())
        torch.testing.assert_close(
            point_box_distance(points, box), torch.from_numpy(expected), rtol=0, atol=1e-12
        )


def test_corners_in_order():
    box = torch.tensor([1.0, 2.0, math.pi / 2, 3.0, 0.5], **F64)
    expected = torch.tensor([[0.5, 5.0], [1.5, 5.0], [1.5, -1.0], [0.5, -1.0]], **F64)
    torch.testing.assert_close(box_corners(box), expected)


@pytest.mark.parametrize(
    ("second", "expected"),
    [
        ((4.0, 0.0, 0.0, 1.0, 1.0), 2.0),  # edge to edge
        ((5.0, 6.0, 0.0, 1.0, 1.0), 5.0),  # corner to corner: 3-4-5
        ((4.0, 0.0, math.pi / 4, 1.0, 1.0), 3 - math.sqrt(2)),  # corner to edge
        ((2.0, 0.0, 0.0, 1.0, 1.0), 0.0),  # touching
        ((0.2, 0.1, 0.7, 0.1, 0.1), 0.0),  # one inside the other
        ((1.5, 1.5, 0.3, 1.0, 1.0), 0.0),  # overlapping corners
    ],
)
def test_box_to_box(second, expected):
    first = torch.tensor([0.0, 0.0, 0.0, 1.0, 1.0], **F64)
    second = torch.tensor(second, **F64)
    expected = torch.tensor(expected, **F64)
    torch.testing.assert_close(box_box_distance(first, second), expected)
    torch.testing.assert_close(box_box_distance(second, first), expected)


@pytest.mark.parametrize("yaw", [0.0, 0.3, -1.2])
def test_crossing_boxes_without_a_corner_inside_the_other_are_at_zero(yaw):
    first = torch.tensor([0.0, 0.0, yaw, 3.0, 0.2], **F64)
    second = torch.tensor([0.1, 0.1, yaw + math.pi / 2, 3.0, 0.2], **F64)
    assert (point_box_distance(box_corners(first), second) > 0).all()
    assert (point_box_distance(box_corners(second), first) > 0).all()
    assert box_box_distance(first, second) == 0


def test_box_distances_against_brute_force_sampling():
    per_side = 25
    first, second = _random_boxes(300), _random_boxes(300)
    distance = box_box_distance(first, second).numpy()
    assert (distance == 0).sum() > 30 and (distance > 0).sum() > 30
    for a, b, value in zip(first.numpy(), second.numpy(), distance):
        # Points of one box seen from the other: their nearest overestimates the distance by no
        # more than half the diagonal of a grid cell.
        points, reach = _grid(a, per_side)
        sampled = _signed_distance_oracle(points, b).clip(min=0).min()
        assert sampled - reach <= value <= sampled + 1e-12


def test_batches_broadcast():
    first, second = _random_boxes(6).reshape(6, 1, 5), _random_boxes(4)
    distance = box_box_distance(first, second)
    assert distance.shape == (6, 4)
    torch.testing.assert_close(distance[3, 2], box_box_distance(first[3, 0], second[2]))


@pytest.mark.parametrize(
    ("start", "end", "expected"),
    [
        ((-3.0, 2.0), (3.0, 2.0), 1.0),  # along an edge
        ((2.0, -3.0), (2.0, 5.0), 1.0),
        ((-3.0, 0.2), (3.0, -0.1), 0.0),  # right through
        ((0.1, 0.1), (0.2, 0.3), 0.0),  # inside
        ((4.0, 5.0), (9.0, 9.0), 5.0),  # its end is nearest: 3-4-5
        ((4.0, 5.0), (4.0, 5.0), 5.0),  # a point
    ],
)
def test_segment_to_box(start, end, expected):
    box = torch.tensor([0.0, 0.0, 0.0, 1.0, 1.0], **F64)
    distance = segment_box_distance(torch.tensor(start, **F64), torch.tensor(end, **F64), box)
    torch.testing.assert_close(distance, torch.tensor(expected, **F64))


def test_segments_against_sampled_points():
    steps = 400
    start, end = 3 * torch.rand(2, 200, 2, **F64) - 1.5
    boxes = _random_boxes(200)
    distance = segment_box_distance(start, end, boxes).numpy()
    share = np.linspace(0, 1, steps)[:, None]
    for a, b, box, value in zip(start.numpy(), end.numpy(), boxes.numpy(), distance):
        sampled = _signed_distance_oracle(a + share * (b - a), box).clip(min=0).min()
        reach = np.linalg.norm(b - a) / (steps - 1) / 2
        assert sampled - reach <= value <= sampled + 1e-12


@pytest.mark.parametrize("shape", [(0,), (1,), (2, 37)])
def test_functions_of_arrays(shape):
    x, y = np.random.default_rng(0).normal(size=(2, *shape))
    for values in ((x, y), (x.T, y.T)):
        np.testing.assert_allclose(norm(np.stack(values, -1)), np.hypot(*values), rtol=1e-15)
        np.testing.assert_allclose(arctan2(*values), np.arctan2(*values), rtol=1e-15)
    cos, sin = cos_sin(x)
    np.testing.assert_allclose(cos, np.cos(x), rtol=0, atol=1e-15)
    np.testing.assert_allclose(sin, np.sin(x), rtol=0, atol=1e-15)
