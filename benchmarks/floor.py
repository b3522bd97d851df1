"""The floor: operations of an update over the rate at which this machine multiplies matrices."""

from __future__ import annotations

import time
from collections.abc import Callable

import torch
from torch.utils.flop_counter import FlopCounterMode

# The networks' own products, and large ones: the better of the two is the rate.
_SIZES = {256: 24, 1024: 1}


def flops(run: Callable[[], object]) -> int:
    """Floating point operations of the matrix products in a call, forward and backward."""
    counter = FlopCounterMode(display=False)
    with counter:
        run()
    return counter.get_total_flops()


class MatrixRate:
    """Floating point operations per second, measured anew at every call.

    Args:
        precision: of the matrices.
    """

    def __init__(self, precision: torch.dtype) -> None:
        self.matrices = {size: torch.randn(size, size).to(precision) for size in _SIZES}

    def __call__(self, clock: Callable[[], float] = time.perf_counter) -> float:
        rates = []
        for size, number in _SIZES.items():
            matrix = self.matrices[size]
            start = clock()
            for _ in range(number):
                torch.mm(matrix, matrix)
            rates.append(number * 2 * size**3 / (clock() - start))
        return max(rates)
