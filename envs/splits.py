"""Which seeds draw scenes for training, for validation and for testing: they never share one.

=============================  ======================================================
seeds                          their scenes are for
=============================  ======================================================
7 to 9,999                     tests: the numbers that are reported
1,000,000 to 1,999,999         validation: which checkpoint is kept
all others up to 2**32 - 1     training
=============================  ======================================================

PyTorch's generator on the CPU knows a seed by its lower 32 bits alone: 7 and ``7 + 2**40`` draw the
same scenes. So everything here stays below ``2**32``.

What an environment draws besides scenes (faults, failed scenes that come again) is from generators of
their own, and no scene comes from those.
"""

from __future__ import annotations

from .fields import shown

TEST_SEEDS = range(7, 10_000)
VALIDATION_SEEDS = range(1_000_000, 2_000_000)

_SHIFT = 2**31


def training_seed(seed: int) -> int:
    """The seed itself, unless it is reserved: then one above 2**31, which no other seed becomes.

    Args:
        seed: of a training, from 0 to 2**31 - 1.

    Raises:
        ValueError: for any other.

    Examples:
        >>> training_seed(0), training_seed(7), training_seed(1_000_003)
        (0, 2147483655, 2148483651)
    """
    _check(seed, 0, _SHIFT - 1)
    return seed + _SHIFT if seed in TEST_SEEDS or seed in VALIDATION_SEEDS else seed


def check_test_seed(seed: int) -> int:
    """The seed, if its scenes are for tests.

    Raises:
        ValueError: for any other; it says what the seed is for.

    Examples:
        >>> check_test_seed(0)
        Traceback (most recent call last):
            ...
        ValueError: Seed 0 draws scenes for training: those for tests have seeds 7 to 9,999.
    """
    return _reserved(seed, TEST_SEEDS, "tests")


def check_validation_seed(seed: int) -> int:
    """The seed, if its scenes are for validation.

    Raises:
        ValueError: for any other; it says what the seed is for.
    """
    return _reserved(seed, VALIDATION_SEEDS, "validation")


def _reserved(seed: int, seeds: range, purpose: str) -> int:
    _check(seed, 0, 2**32 - 1)
    if seed in seeds:
        return seed
    used = (
        "tests" if seed in TEST_SEEDS else "validation" if seed in VALIDATION_SEEDS else "training"
    )
    raise ValueError(
        f"Seed {seed} draws scenes for {used}: those for {purpose} have seeds "
        f"{seeds.start:,} to {seeds[-1]:,}."
    )


def _check(seed: int, low: int, high: int) -> None:
    if not isinstance(seed, int) or isinstance(seed, bool) or not low <= seed <= high:
        raise ValueError(f"A seed must be a whole number from {low} to {high}, got {shown(seed)}.")
