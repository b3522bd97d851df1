"""Tensors of what recordings come as: NumPy arrays and nested lists."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

__all__ = ["as_flags", "as_numbers", "as_tensor"]


def as_tensor(values: Tensor | ArrayLike) -> Tensor:
    """A tensor of the same values; tensors are returned as they are.

    Args:
        values: any shape.

    Raises:
        ValueError: for rows of different lengths.

    Example:
        >>> as_tensor([[0.0, 1.0], [2.0]])
        Traceback (most recent call last):
        ...
        ValueError: rows differ in length: pad them to one length, and mark with a mask what counts.
    """
    if isinstance(values, Tensor):
        return values
    try:
        array = np.asarray(values)
    except ValueError:
        raise ValueError(
            "rows differ in length: pad them to one length, and mark with a mask what counts."
        ) from None
    # PyTorch cannot show a read-only or reversed array.
    return torch.from_numpy(np.require(array, requirements=["C", "W"]))


def as_numbers(values: Tensor | ArrayLike) -> Tensor:
    """A floating-point tensor; whole numbers become such.

    Example:
        >>> as_numbers([[0, 1]])
        tensor([[0., 1.]])
    """
    tensor = as_tensor(values)
    return tensor if tensor.is_floating_point() else tensor.to(torch.get_default_dtype())


def as_flags(values: Tensor | ArrayLike) -> Tensor:
    """A boolean tensor; numbers that are not 0 are true.

    Example:
        >>> as_flags([1, 0])
        tensor([ True, False])
    """
    return as_tensor(values).bool()
