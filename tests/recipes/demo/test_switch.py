"""A change of preference on the way: what it changes, and what is said of it."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from tensordict import TensorDict

from recipes.demo.switch import Switch, switch
from tests._sweeps import BEND, SPACE, bend


def test_path_is_the_old_one_up_to_the_change_and_another_one_after_it():
    preferences = torch.tensor([[0.0, 1.0], [1.0, 0.0]])
    change = switch(BEND, SPACE, preferences, switch_step=12)
    first, second, switched = change.paths["position"]
    assert torch.equal(switched[:13], first[:13])  # the start and the 12 steps before
    assert not torch.equal(second[:13], first[:13])
    assert (switched[13:] != first[13:]).any(-1).all()
    low, high = torch.tensor([0.0, -math.pi]), torch.tensor([0.5, math.pi])
    expected = low + (bend(preferences) + 1) / 2 * (high - low)
    torch.testing.assert_close(change.actions[2, 11], expected[0])
    torch.testing.assert_close(change.actions[2, 12], expected[1])
    assert change.separation == pytest.approx((switched[17] - first[17]).norm().item())
    assert change.separation > 0.05


def test_change_between_equal_preferences_changes_nothing():
    change = switch(BEND, SPACE, torch.tensor([[0.5, 0.5], [0.5, 0.5]]), switch_step=10)
    assert torch.equal(change.paths["position"][2], change.paths["position"][0])
    assert change.separation == 0.0


def test_change_without_a_second_to_look_back_on_has_no_separation():
    preferences = torch.tensor([[0.0, 1.0], [1.0, 0.0]])

    def drive(steps):
        return switch(BEND, SPACE, preferences, switch_step=12, max_episode_steps=steps)

    # One second after the change is 5 steps of 0.2 s later, at the end of the 17th.
    assert drive(17).separation == drive(18).separation > 0.05
    assert drive(17).turned > 0
    for too_short in (16, 12, 3):  # the last one ends before the change
        change = drive(too_short)
        assert math.isnan(change.separation) and math.isnan(change.turned)


def test_only_the_two_compared_runs_must_last_for_that_second():
    path = torch.arange(8.0).repeat(3, 1)
    change = Switch(
        paths=TensorDict(
            position=torch.stack((path, path * torch.tensor([[0.0], [0.0], [2.0]])), dim=-1),
            heading=path * torch.tensor([[0.0], [0.0], [math.radians(10)]]),
            mask=torch.ones(3, 8, dtype=torch.bool),
            batch_size=[3],
        ),
        actions=torch.zeros(3, 7, 2),
        switch_step=1,
    )
    assert change.separation == 12.0  # after six steps: one second after the first of them
    assert change.turned == pytest.approx(60.0)
    change.paths["mask"][1, 2:] = False  # the run under the second preference
    assert change.separation == 12.0
    for row in (0, 2):
        mask = change.paths["mask"].clone()
        mask[row, 6:] = False  # what follows the end of an episode means nothing
        ended = dataclasses.replace(change, paths=change.paths.clone().set("mask", mask))
        assert math.isnan(ended.separation) and math.isnan(ended.turned)
