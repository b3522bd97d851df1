"""Closeness to people and boxes in closed form: a pass, a visit, an approach, a standing robot."""

from __future__ import annotations

import math

import pytest
import torch

from torchrl_morl.evaluation import (
    human_exposure,
    min_clearance,
    min_human_distance,
    min_surface_distance,
    min_time_to_collision,
    personal_space_compliance,
    space_violations,
)

F64 = torch.float64
DT = 0.5
R, H = 0.2, 0.3  # radii of robot and human: they touch at half a metre


def track(x, y=0.0) -> torch.Tensor:
    x = torch.as_tensor(x, dtype=F64)
    return torch.stack((x, torch.as_tensor(y, dtype=F64).expand_as(x)), dim=-1)


def whole(path: torch.Tensor) -> torch.Tensor:
    return torch.ones(path.shape[:-1], dtype=torch.bool)


def collision(position, human) -> float:
    return min_time_to_collision(position, human, whole(position), DT, R, H).item()


# --- distance


def test_surfaces_are_nearer_than_centres_by_both_radii():
    position, human = track([0.0, 1.0, 2.0]), track([2.0, 2.0, 2.0], 1.5)
    assert min_human_distance(position, human, whole(position)).item() == 1.5
    value = min_surface_distance(position, human, whole(position), R, H)
    assert value.item() == pytest.approx(1.5 - R - H)
    touching = min_surface_distance(position, human - torch.tensor([0.0, 1.1]), whole(human), R, H)
    assert touching.item() == 0.0


# --- personal space


def test_a_straight_pass_spends_its_chord_in_the_personal_space():
    # 10 m past a human 0.3 m beside the way: 0.8 m of it are closer than 0.5 m.
    position = track(torch.linspace(-5, 5, 10_001, dtype=F64))
    human = torch.tensor([0.0, 0.3], dtype=F64).expand_as(position)
    value = personal_space_compliance(position, human, whole(position))
    assert value.item() == pytest.approx(1 - 0.8 / 10, abs=2e-4)
    assert space_violations(position, human, whole(position)) == 1


def test_compliance_is_one_outside_and_at_the_edge_and_zero_inside():
    standing = track(torch.zeros(4))
    for distance, share in ((2.0, 1.0), (0.5, 1.0), (0.49, 0.0), (0.0, 0.0)):
        human = track(torch.full((4,), distance))
        assert personal_space_compliance(standing, human, whole(human)) == share
        assert space_violations(standing, human, whole(human)) == 1 - share


def test_every_visit_counts_once():
    # Inside at the start, out, in for three points, out, in at the end.
    x = torch.tensor([0.2, 1.0, 0.4, 0.0, -0.4, -1.0, -0.3])
    human = torch.zeros(7, 2, dtype=F64)
    assert space_violations(track(x), human, whole(human)) == 3
    assert personal_space_compliance(track(x), human, whole(human)).item() == pytest.approx(2 / 7)
    wider = space_violations(track(x), human, whole(human), threshold=1.5)
    assert wider == 1


# --- exposure


def test_exposure_of_a_straight_pass_is_its_integral():
    # Through the human from 2 m before to 2 m behind at 1 m/s: twice the integral of x² from 0 to 2.
    position = track(torch.linspace(-5, 5, 10_001, dtype=F64))
    human = torch.zeros_like(position)
    value = human_exposure(position, human, whole(position), dt=0.001)
    assert value.item() == pytest.approx(2 * 8 / 3, rel=1e-5)
    assert human_exposure(position, human, whole(position), 0.002).item() == pytest.approx(32 / 3)
    nobody_near = human + torch.tensor([0.0, 2.0])
    assert human_exposure(position, nobody_near, whole(position), 0.001) == 0


def test_who_cuts_a_corner_comes_nearer_and_is_exposed_less():
    # Up to 1 m before the human and round him, or past him at 0.9 m.
    human = torch.zeros(1, 2, dtype=F64)
    angle = torch.linspace(torch.pi, 0, 32, dtype=F64).unsqueeze(-1)
    orbit = torch.cat((angle.cos(), angle.sin()), -1)
    ahead = track(torch.linspace(-2, -1, 11, dtype=F64))
    around = torch.cat((ahead, orbit, -ahead.flip(0)))
    past = torch.stack((torch.arange(-20, 21) / 10, torch.full((41,), 0.9)), -1).to(F64)
    assert min_human_distance(past, human, whole(past)) < min_human_distance(
        around, human, whole(around)
    )
    assert human_exposure(past, human, whole(past), 0.2) < human_exposure(
        around, human, whole(around), 0.2
    )


# --- time to collision


def test_approach_that_stops_in_time():
    # At 1 m/s towards a human who stands 3 m ahead; the last moving point is at 1 m.
    position, human = track([0.0, 0.5, 1.0, 1.0, 1.0]), track([3.0] * 5)
    assert collision(position, human) == pytest.approx(3.0 - 1.0 - R - H)


def test_both_speeds_count_and_so_does_the_offset():
    # Closing at 2 m/s, 0.3 m aside: circles of half a metre touch 0.4 m before they are level.
    position, human = track([0.0, 0.5]), track([5.0, 4.5], 0.3)
    assert collision(position, human) == pytest.approx((4.0 - 0.4) / 2)


def test_pass_at_a_distance_is_no_collision():
    position = track(torch.linspace(0, 6, 13))
    assert collision(position, track([3.0] * 13, 2.0)) == math.inf
    assert collision(position, track([3.0] * 13, 0.51)) == math.inf
    assert collision(position, track([3.0] * 13, 0.49)) == 0.0  # drives through


def test_leaving_and_standing_are_no_collision():
    human = track([0.0] * 4)
    assert collision(track([1.0, 2.0, 3.0, 4.0]), human) == math.inf
    assert collision(track([1.0] * 4), human) == math.inf
    assert collision(track([1.0, 2.0, 3.0, 4.0]), track([0.0, 1.0, 2.0, 3.0])) == math.inf


def test_human_walks_into_a_standing_robot():
    position, human = track([0.0] * 4), track([4.0, 3.0, 2.0, 1.5])
    # At 2 m/s from 2 m, then at 1 m/s from 1.5 m: the first would be there earlier.
    assert collision(position, human) == pytest.approx((2.0 - R - H) / 2)


def test_contact_is_zero_even_at_the_only_point():
    assert collision(track([0.0]), track([0.4])) == 0.0
    assert math.isnan(collision(track([0.0]), track([2.0])))
    assert collision(track([0.0, 0.0]), track([0.4, 2.0])) == 0.0


def test_gap_in_the_mask_is_no_movement():
    position, human = track([0.0, 0.0, 2.0]), track([3.0] * 3)
    mask = torch.tensor([True, False, True])
    assert min_time_to_collision(position, human, mask, DT, R, H).isnan()


def test_time_to_collision_against_a_fine_search():
    generator = torch.Generator().manual_seed(3)
    position, human = torch.randn(2, 500, 2, 2, generator=generator, dtype=F64)
    human[:, 1] = human[:, 0] + 0.1 * human[:, 1]  # people are slower, or nobody would be hit
    result = min_time_to_collision(position, human, whole(position), DT, R, H)
    offset, velocity = (human - position)[:, 1], (human - position).diff(dim=-2)[:, 0] / DT
    time = torch.arange(0, 10, 1e-3, dtype=F64)
    apart = (offset[:, None] + velocity[:, None] * time[:, None]).norm(dim=-1)
    hit = apart <= R + H
    expected = torch.where(hit.any(-1), time[hit.int().argmax(-1)], torch.inf)
    touched = (human - position).norm(dim=-1).amin(-1) <= R + H
    expected = torch.where(touched, 0.0, expected)
    # The search misses what grazes between two of its times, and what is later than its last.
    seen = (apart.amin(-1) - R - H).abs() > 1e-3
    assert ((expected > 0) & expected.isfinite() & seen).sum() > 20 and seen.sum() > 480
    torch.testing.assert_close(result[seen], expected[seen], rtol=0, atol=2e-3)


# --- boxes


def test_clearance_to_a_turned_box():
    # A square of half width 1 on its corner reaches to sqrt(2).
    box = torch.tensor([[0.0, 0.0, math.pi / 4, 1.0, 1.0]], dtype=F64)
    position = track([-4.0, -3.0, -2.0])
    value = min_clearance(position, box, whole(position), radius=R)
    assert value.item() == pytest.approx(2.0 - math.sqrt(2) - R)
    inside = track([0.0, 0.5])
    assert min_clearance(inside, box, whole(inside), radius=R) == 0


def test_clearance_counts_the_nearest_box_of_each_scene():
    position = track([0.0, 1.0, 2.0]).expand(3, 2, 3, 2)  # three policies in two scenes
    boxes = torch.zeros(2, 2, 5, dtype=F64)
    boxes[..., 3:] = 0.5
    boxes[:, 0, :2] = torch.tensor([[2.0, 3.0], [9.0, 9.0]])
    boxes[:, 1, :2] = torch.tensor([[-9.0, 0.0], [-4.0, 0.0]])
    value = min_clearance(position, boxes, whole(position), radius=R)
    torch.testing.assert_close(value, torch.tensor([2.3, 3.3], dtype=F64).expand(3, 2))


def test_clearance_without_boxes_is_undefined():
    position = track([0.0, 1.0]).expand(4, 2, 2)
    assert min_clearance(position, torch.zeros(4, 0, 5), whole(position), R).isnan().all()
