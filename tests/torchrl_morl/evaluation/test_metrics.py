"""Success weighted by length and time in closed form, and what every metric of a trajectory owes."""

from __future__ import annotations

import math
import re
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from torchrl_morl.evaluation import (
    cumulative_heading_change,
    discrete_frechet,
    human_exposure,
    intervals,
    mean_jerk,
    min_clearance,
    min_human_distance,
    min_surface_distance,
    min_time_to_collision,
    path_irregularity,
    path_length,
    personal_space_compliance,
    resample_path,
    space_violations,
    spl,
    stalled_time,
    statistics,
    stl,
    time_to_goal,
)

F64 = torch.float64
YES, NO = torch.tensor(True), torch.tensor(False)


def whole(points: int) -> torch.Tensor:
    return torch.ones(points, dtype=torch.bool)


def straight(points: int = 11, step: float = 0.5) -> torch.Tensor:
    x = step * torch.arange(points, dtype=F64)
    return torch.stack((x, torch.zeros_like(x)), dim=-1)


# --- success weighted by length and time


def test_spl_of_the_shortest_way_is_one():
    path = straight()
    assert spl(YES, path, whole(11), torch.tensor(5.0)).item() == 1.0
    # Measured to the goal's centre, of which the robot need not reach more than the edge.
    assert spl(YES, path, whole(11), torch.tensor(5.3)).item() == 1.0


def test_spl_of_half_a_circle_is_two_over_pi():
    angle = torch.linspace(math.pi, 0, 2001, dtype=F64)
    path = torch.stack((angle.cos(), angle.sin()), dim=-1)
    assert spl(YES, path, whole(2001), torch.tensor(2.0)).item() == pytest.approx(2 / math.pi)


def test_stl_is_the_share_of_the_reference_time():
    mask = whole(21)
    for reference, expected in ((8.0, 0.8), (10.0, 1.0), (12.0, 1.0)):
        value = stl(YES, mask, dt=0.5, reference=torch.tensor(reference))
        assert value.item() == pytest.approx(expected)


def test_a_failure_is_zero_however_short():
    assert spl(NO, straight(3), whole(3), torch.tensor(5.0)) == 0
    assert stl(NO, whole(3), dt=0.2, reference=torch.tensor(5.0)) == 0


@pytest.mark.parametrize("success", [YES, NO])
def test_without_a_reference_nothing_is_known(success):
    unknown = torch.tensor(math.nan)
    assert spl(success, straight(), whole(11), unknown).isnan()
    assert stl(success, whole(11), dt=0.2, reference=unknown).isnan()


def test_start_in_the_goal():
    standing = torch.zeros(4, 2)
    assert spl(YES, standing, whole(4), torch.tensor(0.0)).isnan()
    assert spl(YES, straight(4), whole(4), torch.tensor(0.0)) == 0


@pytest.mark.parametrize(
    ("metric", "name"),
    [
        (partial(spl, YES, straight(), whole(11)), "shortest"),
        (partial(stl, YES, whole(11), 0.2), "reference"),
    ],
)
def test_negative_references_are_refused(metric, name):
    with pytest.raises(ValueError, match=f"{name} must not be negative, got -0.5"):
        metric(torch.tensor([math.nan, 1.0, -0.5]))


# --- what every metric owes

GOAL = torch.tensor([3.0, 1.0], dtype=F64)
BOXES = torch.tensor([[1.0, 1.0, 0.3, 0.5, 0.2], [-2.0, 0.5, 1.0, 0.4, 0.4]], dtype=F64)
HUMAN = {
    "min_human_distance": min_human_distance,
    "min_surface_distance": partial(min_surface_distance, radius=0.1, human_radius=0.1),
    "human_exposure": partial(human_exposure, dt=0.2),
    "personal_space_compliance": personal_space_compliance,
    "space_violations": space_violations,
    "min_time_to_collision": partial(min_time_to_collision, dt=0.2, radius=0.05, human_radius=0.05),
}
METRICS = {
    "path_length": lambda p, h, a, m: path_length(p, m),
    "time_to_goal": lambda p, h, a, m: time_to_goal(torch.ones_like(m[..., 0]), m, 0.2),
    "spl": lambda p, h, a, m: spl(torch.ones_like(m[..., 0]), p, m, p.new_tensor(1.5)),
    "stl": lambda p, h, a, m: stl(torch.ones_like(m[..., 0]), m, 0.2, p.new_tensor(0.7)),
    **{name: lambda p, h, a, m, f=f: f(p, h, m) for name, f in HUMAN.items()},
    "min_clearance": lambda p, h, a, m: min_clearance(p, BOXES, m, radius=0.1),
    "stalled_time": lambda p, h, a, m: stalled_time(p, m, 0.2, threshold=2.0),
    "mean_jerk": lambda p, h, a, m: mean_jerk(p, m, 0.2),
    "cumulative_heading_change": lambda p, h, a, m: cumulative_heading_change(a, m),
    "path_irregularity": lambda p, h, a, m: path_irregularity(p, a, m, GOAL),
}
every_metric = pytest.mark.parametrize("metric", METRICS.values(), ids=METRICS)
of_positions = pytest.mark.parametrize(
    "metric",
    [metric for name, metric in METRICS.items() if name not in ("time_to_goal", "stl")],
    ids=[name for name in METRICS if name not in ("time_to_goal", "stl")],
)


def episodes():
    """Six random walks around each other ``[2, 3, 9]`` and their masks: 9 to 4 points."""
    generator = torch.Generator().manual_seed(1)
    walk = torch.randn(3, 2, 3, 9, 2, generator=generator, dtype=F64)
    position, human, _ = 0.4 * walk.cumsum(-2)
    heading = 2 * walk[2, ..., 0]
    mask = torch.arange(9) < torch.tensor([[9, 8, 7], [6, 5, 4]]).unsqueeze(-1)
    return position, human, heading, mask


@every_metric
@pytest.mark.parametrize("rubbish", [0.0, 1e6, math.inf, math.nan])
def test_padding_does_not_count(metric, rubbish):
    position, human, heading, mask = episodes()
    for tensor in (position, human, heading):
        tensor[~mask] = rubbish
    values = metric(position, human, heading, mask)
    assert values.shape == (2, 3)
    for i in range(2):
        for j in range(3):
            n = int(mask[i, j].sum())
            alone = metric(position[i, j, :n], human[i, j, :n], heading[i, j, :n], whole(n))
            assert not alone.isnan()
            torch.testing.assert_close(values[i, j], alone, check_dtype=False)


@every_metric
def test_no_points_no_value(metric):
    position, human, heading, mask = episodes()
    mask[0, 1] = False
    expected = torch.tensor([[False, True, False], [False, False, False]])
    assert torch.equal(metric(position, human, heading, mask).isnan(), expected)


@of_positions
def test_nan_before_the_end_is_not_swallowed(metric):
    position, human, heading, mask = episodes()
    for tensor in (position, heading):
        tensor[1, 0, 2] = math.nan
    expected = torch.tensor([[False, False, False], [True, False, False]])
    assert torch.equal(metric(position, human, heading, mask).isnan(), expected)


def test_the_glossary_has_every_metric():
    text = (Path(__file__).parents[3] / "docs" / "metrics.md").read_text()
    others = {"discrete_frechet", "steerability", "hypervolume", "expected_utility"}
    others |= {name for name in intervals.__all__ + statistics.__all__ if name.islower()}
    assert {*METRICS, *others} <= set(re.findall(r"^\| `(\w+)` \|", text, flags=re.MULTILINE))


@pytest.mark.parametrize("metric", HUMAN.values(), ids=HUMAN)
def test_human_that_was_not_seen_is_not_far_away(metric):
    position, human, _, mask = episodes()
    human[0, 2, 3] = math.nan
    assert metric(position, human, mask)[0, 2].isnan()
    assert not metric(position, human, mask)[0, 1].isnan()


# --- recordings are NumPy arrays, or lists


@every_metric
def test_numpy_arrays_and_lists_give_the_same(metric):
    expected = metric(*episodes())

    def ask(convert):
        # The table above makes other arguments from tensors.
        position, human, heading, mask = (convert(x) for x in episodes())
        name = next(name for name, function in METRICS.items() if function is metric)
        success = convert(torch.ones(2, 3, dtype=torch.bool))
        calls = {
            "time_to_goal": lambda: time_to_goal(success, mask, 0.2),
            "spl": lambda: spl(
                success, position, mask, convert(torch.full((2, 3), 1.5, dtype=F64))
            ),
            "stl": lambda: stl(success, mask, 0.2, convert(torch.full((2, 3), 0.7, dtype=F64))),
            "min_clearance": lambda: min_clearance(position, convert(BOXES), mask, radius=0.1),
            "path_irregularity": lambda: path_irregularity(position, heading, mask, convert(GOAL)),
        }
        return calls.get(name, lambda: metric(position, human, heading, mask))()

    for convert in (torch.Tensor.numpy, torch.Tensor.tolist):
        torch.testing.assert_close(ask(convert), expected, check_dtype=False)


def test_a_recording_as_it_comes():
    # Whole metres, flags of 0 and 1, an array that nobody may write to, seen from its end.
    way = np.array([[0, 0], [3, 4], [3, 5]])[::-1]
    way.flags.writeable = False
    assert path_length(way, [1, 1, 1]) == 6.0
    assert path_length(way, [1, 1, 0]) == 1.0
    assert time_to_goal([1, 0], [[1, 1, 1], [1, 1, 1]], 0.5).tolist()[0] == 1.0
    assert discrete_frechet(way, [1, 1, 1], way + np.array([0, 2]), np.ones(3)) == 2.0
    assert resample_path(way, [True] * 3, 7)[1].tolist() == [3.0, 4.0]
    with pytest.raises(ValueError, match="rows differ in length: pad them"):
        path_length([[[0, 0], [1, 0]], [[0, 0]]], [[1, 1], [1, 0]])
