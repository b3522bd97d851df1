"""Tensors of what recordings come as: NumPy arrays and nested lists."""

from __future__ import annotations

import reprlib

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

__all__ = ["as_flags", "as_numbers", "as_points", "as_tensor", "check_lengths"]


def as_tensor(values: Tensor | ArrayLike) -> Tensor:
    """A tensor of the same values; tensors are returned as they are.

    Args:
        values: any shape.

    Raises:
        ValueError: for rows of different lengths, or what is no numbers.

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
    if array.dtype.kind not in "fiubc":
        raise ValueError(f"an array of numbers is needed, got {reprlib.repr(values)}.")
    # PyTorch cannot show a read-only or reversed array.
    return torch.from_numpy(np.require(array, requirements=["C", "W"]))


def as_numbers(values: Tensor | ArrayLike) -> Tensor:
    """A floating-point tensor; whole numbers become such.

    Example:
        >>> as_numbers([[0, 1]])
        tensor([[0., 1.]])
    """
    tensor = as_tensor(values)
    if tensor.is_complex():
        raise ValueError(f"an array of real numbers is needed, got {tensor.dtype}.")
    return tensor if tensor.is_floating_point() else tensor.to(torch.get_default_dtype())


def as_flags(values: Tensor | ArrayLike) -> Tensor:
    """A boolean tensor; numbers that are not 0 are true.

    Example:
        >>> as_flags([1, 0])
        tensor([ True, False])
    """
    return as_tensor(values).bool()


def as_points(name: str, values: Tensor | ArrayLike, size: int = 2) -> Tensor:
    """Points ``[..., size]`` as a floating-point tensor.

    Raises:
        ValueError: for another last dimension.

    Example:
        >>> as_points("position", [[0, 1, 2]])
        Traceback (most recent call last):
        ...
        ValueError: position must have shape [..., 2], got [1, 3].
    """
    tensor = as_numbers(values)
    if tensor.ndim < 1 or tensor.shape[-1] != size:
        raise ValueError(f"{name} must have shape [..., {size}], got {list(tensor.shape)}.")
    return tensor


def check_lengths(**lengths: Tensor | ArrayLike) -> None:
    """Raise ``ValueError`` unless radii, thresholds and the like are numbers from 0 on."""
    for name, value in lengths.items():
        if not (as_numbers(value) >= 0).all():  # NaN is not
            raise ValueError(f"{name} must be at least 0, got {reprlib.repr(value)}.")
