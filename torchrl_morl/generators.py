"""Random generators of components: their state, as a tensor of the state dict."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["generator_from", "generator_state"]


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
