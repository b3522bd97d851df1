"""What a component is given: refused at once, in one line with the name, the value and what is allowed."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded

from torchrl_morl import PreferenceSpace
from torchrl_morl.modules import RewardModel, make_actor, make_vector_critic
from torchrl_morl.objectives import MOTD3Loss
from torchrl_morl.transforms import (
    CheckFinite,
    LidarMinPool,
    LogRange,
    PolarFeatures,
    PreferenceExpand,
    PreferenceRelabel,
    PreferenceSampler,
    RewardModelReward,
    ScalarizeReward,
)

SPACE = PreferenceSpace(("core", "distance", "efficiency"), static={"core": 1.0})
SPEC = Bounded(-1.0, 1.0, (2,))
MODEL = RewardModel(in_features=4, num_cells=(4,))
ACTOR = make_actor(SPEC, in_features=6, num_cells=(8,))
CRITIC = make_vector_critic(3, in_features=8, num_cells=(8,))

MISTAKES: list[tuple[Callable[[], object], str]] = [
    (lambda: PreferenceSampler("demo"), "preference_space must be a PreferenceSpace, got 'demo'"),
    (lambda: ScalarizeReward(None), "preference_space must be a PreferenceSpace, got None"),
    (lambda: PreferenceRelabel(("a", "b")), "preference_space must be a PreferenceSpace, got ('a'"),
    (lambda: PreferenceSampler(SPACE, num_segments=1.5), "num_segments must be a whole number, at"),
    (lambda: PreferenceExpand(SPACE, copies=2.5), "copies must be a whole number, at least 1, got"),
    (lambda: PreferenceRelabel(SPACE, ratio="a"), "ratio must be in [0, 1], got 'a'"),
    (lambda: LidarMinPool(1.5), "num_sectors must be a whole number, at least 1, got 1.5"),
    (lambda: LidarMinPool(0), "num_sectors must be at least 1, got 0"),
    (lambda: LogRange(0.0), "max_range must be positive and finite, got 0.0"),
    (lambda: LogRange(math.nan), "max_range must be positive and finite, got nan"),
    (lambda: PolarFeatures(scale="5"), "the scale of 'goal' must be finite and > 0, got '5'"),
    (lambda: RewardModelReward(None), "reward_model must be a TensorDictModule, got None"),
    (lambda: RewardModelReward(MODEL, position=1.5), "position must be a whole number, at least 0"),
    (lambda: RewardModelReward(MODEL, scale="a"), "scale must be positive and finite, got 'a'"),
    (lambda: RewardModel(in_features=0), "in_features must be at least 1, got 0"),
    (lambda: RewardModel(in_features=4, num_cells=(8, -4)), "num_cells[1] must be at least 1, got"),
    (lambda: make_actor(SPEC, in_features=6, num_cells=(0,)), "num_cells[0] must be at least 1"),
    (lambda: make_actor(SPEC, in_features=6, num_cells=(1.5,)), "num_cells[0] must be a whole"),
    (
        lambda: make_actor(Bounded(-math.inf, math.inf, (2,)), in_features=6),
        "the bounds of action_spec must be finite",
    ),
    (lambda: make_vector_critic(1.5, in_features=6), "num_objectives must be a whole number, at"),
    (
        lambda: MOTD3Loss(ACTOR, CRITIC, preference_space="abc", action_spec=SPEC),
        "preference_space must be a PreferenceSpace, got 'abc'",
    ),
    (
        lambda: MOTD3Loss(
            ACTOR, CRITIC, preference_space=SPACE, action_spec=SPEC, num_qvalue_nets=0
        ),
        "num_qvalue_nets must be at least 1, got 0",
    ),
    (
        lambda: MOTD3Loss(
            ACTOR, CRITIC, preference_space=SPACE, action_spec=SPEC, loss_function="huberx"
        ),
        "loss_function must be one of ('l1', 'l2', 'smooth_l1'), got 'huberx'",
    ),
    (lambda: RewardModel(in_features=4, num_members=10**9), "num_members must be at most 10,000"),
    (lambda: RewardModel(in_features=4, device="tpu"), "device must be one that PyTorch"),
    (lambda: make_actor(SPEC, in_features=6, device="cuda:7"), "device must be one that PyTorch"),
    (
        lambda: make_actor(SPEC, in_features=6, num_cells=(10**9,)),
        "num_cells[0] makes a layer of 6",
    ),
    (
        lambda: make_actor(SPEC, in_features=6, num_cells=(10**5, 10**5)),
        "num_cells[1] makes a layer of 100000 x 100000 weights, at most 1,073,741,824 are allowed",
    ),
    (lambda: make_actor(SPEC, in_features=6, num_cells=7), "num_cells must be a list of whole num"),
    (lambda: make_actor(SPEC, in_features=6, num_cells="64"), "num_cells must be a list of whole"),
    (
        lambda: make_vector_critic(10**9, in_features=6),
        "num_objectives must be at most 10,000, got",
    ),
    (
        lambda: PreferenceSampler(SPACE, seed="a"),
        "seed must be a whole number, at least 0, got 'a'",
    ),
    (lambda: PreferenceSampler(SPACE, seed=-1), "seed must be at least 0, got -1"),
    (
        lambda: PreferenceRelabel(SPACE, seed=1.5),
        "seed must be a whole number, at least 0, got 1.5",
    ),
    (
        lambda: SPACE.lattice(10**9),
        "divisions must give at most 10,000,000 preferences, got 1000000",
    ),
    (lambda: SPACE.pairwise_grid(10**9), "steps must be at most 10,000,000, got 1000000000"),
    (lambda: SPACE.validate(None), "preference is no array of numbers"),
    (lambda: SPACE.validate("ab"), "preference is no array of numbers"),
    (lambda: SPACE.validate([[1, 0], [1]]), "preference is no array of numbers"),
    (lambda: SPACE.validate(torch.tensor([1.0 + 5j, 0.0])), "preference is no array of real num"),
    (lambda: SPACE.validate([5.0, 5.0], tol=math.nan), "tol must be a number, at least 0, got nan"),
    (lambda: SPACE.lattice(1.5), "divisions must be a whole number, at least 1, got 1.5"),
    (lambda: SPACE.pairwise_grid(2.5), "steps must be a whole number, at least 2, got 2.5"),
    (
        lambda: PreferenceSpace(("a", "b"), static={"b": "x"}),
        "the static weight of 'b' must be finite, got 'x'",
    ),
]


@pytest.mark.parametrize(("make", "message"), MISTAKES, ids=[message for _, message in MISTAKES])
def test_what_is_refused(make, message):
    with pytest.raises(ValueError) as error:
        make()
    assert message in str(error.value)
    assert len(str(error.value).splitlines()) == 1


def test_a_string_is_one_key_and_not_its_letters():
    data = TensorDict(
        scan=torch.rand(3, 8),
        goal=torch.rand(3, 2),
        preference=SPACE.sample(3),
        reward=torch.rand(3, 3),
        batch_size=[3],
    )
    assert CheckFinite("scan").in_keys == ["scan"]
    assert LidarMinPool(2, "scan", "near")(data.copy())["near"].shape == (3, 2)
    assert PolarFeatures("goal", "seen")(data.copy())["seen"].shape == (3, 3)
    assert ScalarizeReward(SPACE, "reward", "utility")(data.copy())["utility"].shape == (3, 1)
    assert make_actor(SPEC, in_features=8, in_keys="scan").in_keys == ["scan"]


def test_whole_numbers_of_numpy_are_whole_numbers():
    assert LidarMinPool(np.int64(30)).num_sectors == 30
    assert len(SPACE.pairwise_grid(np.int64(3))) == 3
