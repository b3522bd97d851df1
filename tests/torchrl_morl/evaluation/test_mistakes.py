"""Metrics of what is no trajectory: refused in one line, instead of a number that means nothing."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch

from torchrl_morl.evaluation import (
    discrete_frechet,
    human_exposure,
    mean_jerk,
    min_clearance,
    min_human_distance,
    min_surface_distance,
    min_time_to_collision,
    path_irregularity,
    path_length,
    personal_space_compliance,
    space_violations,
    stalled_time,
    stl,
    time_to_goal,
)

POSITION, MASK = torch.rand(2, 5, 2), torch.ones(2, 5, dtype=torch.bool)
HUMAN, SUCCESS = torch.rand(2, 5, 2), torch.ones(2, dtype=torch.bool)
HEADING, BOXES = torch.rand(2, 5), torch.rand(2, 3, 5)
MISTAKES: list[tuple[Callable[[], object], str]] = [
    (lambda: path_length(POSITION[..., 0], MASK), "position must have shape [..., 2], got [2, 5]"),
    (
        lambda: path_length(torch.rand(2, 5, 3), MASK),
        "position must have shape [..., 2], got [2, 5",
    ),
    (
        lambda: path_length(POSITION * 1j, MASK),
        "an array of real numbers is needed, got torch.comp",
    ),
    (lambda: path_length("here", MASK), "an array of numbers is needed, got 'here'"),
    (lambda: path_length(None, MASK), "an array of numbers is needed, got None"),
    (lambda: time_to_goal(SUCCESS, MASK, 0), "dt must be positive and finite, got 0"),
    (lambda: time_to_goal(SUCCESS, MASK, math.nan), "dt must be positive and finite, got nan"),
    (lambda: time_to_goal(SUCCESS, MASK, "0.2"), "dt must be positive and finite, got '0.2'"),
    (lambda: stl(SUCCESS, MASK, -0.2, torch.ones(2)), "dt must be positive and finite, got -0.2"),
    (lambda: stalled_time(POSITION, MASK, 0.2, -1.0), "threshold must be at least 0, got -1.0"),
    (lambda: stalled_time(POSITION, MASK, 0.0), "dt must be positive and finite, got 0.0"),
    (lambda: mean_jerk(POSITION, MASK, -1.0), "dt must be positive and finite, got -1.0"),
    (
        lambda: path_irregularity(POSITION, HEADING, MASK, torch.rand(2, 3)),
        "goal must have shape [..., 2], got [2, 3]",
    ),
    (lambda: min_human_distance(POSITION, HEADING, MASK), "human must have shape [..., 2], got [2"),
    (lambda: min_surface_distance(POSITION, HUMAN, MASK, -0.1, 0.3), "radius must be at least 0"),
    (
        lambda: min_surface_distance(POSITION, HUMAN, MASK, 0.1, math.nan),
        "human_radius must be at least 0, got nan",
    ),
    (lambda: personal_space_compliance(POSITION, HUMAN, MASK, math.nan), "threshold must be at le"),
    (lambda: space_violations(POSITION, HUMAN, MASK, -1), "threshold must be at least 0, got -1"),
    (lambda: human_exposure(POSITION, HUMAN, MASK, 0), "dt must be positive and finite, got 0"),
    (
        lambda: human_exposure(POSITION, HUMAN, MASK, 0.2, -1),
        "threshold must be at least 0, got -1",
    ),
    (
        lambda: min_time_to_collision(POSITION, HUMAN, MASK, 0.0, 0.1, 0.3),
        "dt must be positive and finite, got 0.0",
    ),
    (lambda: min_clearance(POSITION, BOXES[..., :4], MASK, 0.2), "boxes must have shape [..., 5]"),
    (lambda: min_clearance(POSITION, BOXES, MASK, -0.2), "radius must be at least 0, got -0.2"),
    (
        lambda: discrete_frechet(torch.rand(2, 5, 3), MASK, torch.rand(2, 5, 3), MASK),
        "path_a must have shape [..., 2], got [2, 5, 3]",
    ),
]


@pytest.mark.parametrize(("measure", "message"), MISTAKES, ids=[text for _, text in MISTAKES])
def test_what_is_refused(measure, message):
    with pytest.raises(ValueError) as error:
        measure()
    assert message in str(error.value)
    assert len(str(error.value).splitlines()) == 1
