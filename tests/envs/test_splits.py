"""Seeds for training, validation and tests: no scene belongs to two of them."""

from __future__ import annotations

import random

import numpy as np
import pytest
import torch

from envs import Faults, NavigationEnv
from envs.splits import (
    TEST_SEEDS,
    VALIDATION_SEEDS,
    check_test_seed,
    check_validation_seed,
    training_seed,
)

EDGES = [0, 6, 7, 9_999, 10_000, 999_999, 1_000_000, 1_000_003, 1_999_999, 2_000_000, 2**31 - 1]


def _goals(seed: int, **kwargs) -> set[float]:
    env = NavigationEnv(num_envs=64, num_threads=1, seed=seed, scene="empty", **kwargs)
    return set(env.reset()["scene", "goal"][:, 0].tolist())


def test_training_seeds_are_never_reserved_and_never_shared():
    numbers = random.Random(0)
    seeds = [*EDGES, *range(7, 10_000), *(numbers.randrange(2**31) for _ in range(20_000))]
    seeds = sorted(set(seeds))
    used = [training_seed(seed) for seed in seeds]
    assert len(set(used)) == len(seeds)
    # A generator knows a seed by its lower 32 bits.
    assert all(0 <= seed < 2**32 for seed in used)
    assert not any(seed in TEST_SEEDS or seed in VALIDATION_SEEDS for seed in used)


@pytest.mark.parametrize("seed", [*range(7), 10_000, 123_456, 999_999, 2_000_000, 2**31 - 1])
def test_training_seeds_that_nothing_else_uses_stay_as_they_are(seed):
    assert training_seed(seed) == seed


def test_the_generator_knows_only_32_bits_of_a_seed():
    """What the table of the module rests on: a later PyTorch may know more."""

    def drawn(seed: int) -> float:
        return torch.rand((), generator=torch.Generator().manual_seed(seed)).item()

    assert drawn(7) == drawn(7 + 2**40) == drawn(7 + 2**32)
    assert drawn(7) != drawn(7 + 2**31)


def test_training_with_a_test_seed_meets_none_of_its_scenes():
    for seed in (7, 11, 9_999, 1_000_003):
        assert not _goals(seed) & _goals(training_seed(seed))


@pytest.mark.parametrize("seed", [training_seed(7), training_seed(1_999_999)])
def test_large_seeds_go_all_the_way(seed):
    """Through numpy (the scenes that come again), the generator of faults (seed + 1) and TorchRL."""
    faults = Faults(range_noise=(0.0, 0.1))
    env = NavigationEnv(num_envs=2, num_threads=1, repeat_failed=0.5, faults=faults, seed=seed)
    first = env.rollout(3)
    assert env.set_seed(seed) != seed
    env.reset()
    env.set_seed(seed, static_seed=True)
    torch.testing.assert_close(env.reset()["scene"], first[:, 0]["scene"])
    np.random.default_rng(seed)


def test_faults_leave_the_scenes_of_a_seed_alone():
    """Their generator starts at seed + 1, but no scene is drawn from it."""
    faults = Faults(range_noise=(0.0, 0.1), latency=(0, 1))
    assert _goals(6, faults=faults) == _goals(6)
    assert not _goals(6, faults=faults) & _goals(7)


def test_reserved_seeds_are_checked():
    assert check_test_seed(7) == 7 and check_test_seed(9_999) == 9_999
    assert check_validation_seed(1_000_003) == 1_000_003


@pytest.mark.parametrize(
    ("check", "seed", "message"),
    [
        (check_test_seed, 6, r"Seed 6 draws scenes for training: those for tests .* 7 to 9,999"),
        (check_test_seed, 10_000, "draws scenes for training"),
        (check_test_seed, 1_000_003, "Seed 1000003 draws scenes for validation"),
        (check_test_seed, training_seed(7), "draws scenes for training"),
        (check_validation_seed, 7, "draws scenes for tests: .* 1,000,000 to 1,999,999"),
        (check_validation_seed, 2_000_000, "draws scenes for training"),
        (check_test_seed, 7 + 2**32, "must be a whole number from 0 to 4294967295"),
        (training_seed, -1, "must be a whole number from 0 to 2147483647, got -1"),
        (training_seed, 2**31, "must be a whole number"),
        (training_seed, 1.0, "must be a whole number"),
        (training_seed, True, "must be a whole number"),
        (training_seed, "7", "must be a whole number"),
    ],
)
def test_seeds_for_something_else_are_refused(check, seed, message):
    with pytest.raises(ValueError, match=message) as error:
        check(seed)
    assert "\n" not in str(error.value)
