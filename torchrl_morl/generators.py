"""Random generators of components: draws from them, and their state as a tensor of the state dict."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

__all__ = ["generator_from", "generator_state", "rand", "randn"]


def rand(
    shape: Sequence[int],
    generator: torch.Generator | None,
    device: torch.device | str | None = None,
    dtype: torch.dtype | None = None,
) -> Tensor:
    """:func:`torch.rand` that :func:`torch.compile` can trace for batches of any size.

    Args:
        shape (Sequence[int]): of the result.
        generator (torch.Generator, optional): the global one if ``None``, which torch.rand must not be
            told: with ``generator=None`` it refuses a symbolic size
            (https://github.com/pytorch/pytorch/issues/107170).
        device (torch.device, optional): of the result.
        dtype (torch.dtype, optional): of the result.
    """
    own = {} if generator is None else {"generator": generator}
    return torch.rand(shape, **own, device=device, dtype=dtype)


def randn(
    shape: Sequence[int],
    generator: torch.Generator | None,
    device: torch.device | str | None = None,
) -> Tensor:
    """:func:`torch.randn` in the same way, see :func:`rand`."""
    own = {} if generator is None else {"generator": generator}
    return torch.randn(shape, **own, device=device)


def generator_state(generator: torch.Generator | None) -> Tensor:
    """What a component saves of its generator.

    Args:
        generator (torch.Generator, optional): its own, or none for the global one.

    Returns:
        The state, ``uint8``; empty for the global generator, whose state is not the component's.
    """
    return torch.empty(0, dtype=torch.uint8) if generator is None else generator.get_state()


def generator_from(
    state: Tensor, generator: torch.Generator | None = None
) -> torch.Generator | None:
    """Restore what :func:`generator_state` returned.

    Args:
        state (Tensor): the state.
        generator (torch.Generator, optional): set in place, if there is one.

    Returns:
        The generator in that state, or none for the global one.

    Example:
        >>> generator = torch.Generator().manual_seed(3)
        >>> copy = generator_from(generator_state(generator))
        >>> bool(torch.rand((), generator=generator) == torch.rand((), generator=copy))
        True
    """
    if not state.numel():
        return None
    generator = torch.Generator() if generator is None else generator
    return generator.set_state(state.cpu())
