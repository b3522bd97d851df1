"""Numbers that are none: said where they are given, before they become a question or a recommendation."""

from __future__ import annotations

import json
import math

import pytest
import torch

from torchrl_morl.choices import PreferencePosterior, best_preference, next_question

TWO = ("distance", "efficiency")


def test_outcomes_that_are_not_finite_make_no_question_and_no_recommendation():
    posterior = PreferencePosterior(TWO)
    outcomes = torch.randn(3, 4, 2, generator=torch.Generator().manual_seed(0))
    outcomes[1, 2, 0] = math.nan
    message = "^outcomes must be finite, 1 of 24 are not: standardize"
    with pytest.raises(ValueError, match=message):
        next_question(posterior, outcomes)
    with pytest.raises(ValueError, match=message):
        best_preference(posterior, outcomes, torch.eye(4)[:, :2])


@pytest.mark.parametrize(
    ("first", "message"),
    [
        ([1.0, 0.0, 0.0], r"^first must have shape \[\.\.\., 2\] .*got \[3\]"),
        (1.0, r"^first must have shape .*got \[\]"),
        ("a", "^first must hold numbers, got 'a'"),
        (None, "^first must hold numbers, got None"),
        ([10**400, 0], "^first must hold numbers"),
    ],
)
def test_alternatives_that_are_none(first, message):
    posterior = PreferencePosterior(TWO)
    with pytest.raises(ValueError, match=message):
        posterior.predict(first, [0.0, 1.0])
    with pytest.raises(ValueError, match=r"^first must "):
        posterior.answer(first, [0.0, 1.0], "first")
    assert posterior.num_answers == 0


@pytest.mark.parametrize("name", ["particles", "seed"])
def test_numbers_that_no_memory_and_no_generator_takes(name):
    with pytest.raises(ValueError, match=f"^{name} must be at most"):
        PreferencePosterior(tuple("abcdef"), **{name: 10**30})


def test_an_entry_that_stands_twice_is_refused(tmp_path):
    posterior = PreferencePosterior(TWO)
    posterior.answer([1.0, 0.0], [0.0, 1.0], "first")
    text = json.dumps(posterior.state_dict())
    path = tmp_path / "answers.json"
    path.write_text(text[:-1] + ', "choices": []}')
    with pytest.raises(ValueError, match="'choices' stands there twice"):
        PreferencePosterior.load(path)
