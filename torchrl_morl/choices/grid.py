"""Exact inference on a grid of weights, for one context or for several that resemble each other."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["context_log_posterior", "resemblance"]


def resemblance(weights: Tensor, spread: float) -> Tensor:
    """How likely weights in a context are, given what the person weighs in general.

    A Gaussian of the distance, scaled to rows and columns that sum to one (Sinkhorn and Knopp 1967):
    then a context that nobody has asked about has the uniform prior, with any number of others.

    Args:
        weights: of the grid, ``[G, T]``.
        spread: standard deviation of the distance; at 0 all contexts have the same weights.

    Returns:
        ``[G, G]``, symmetric.
    """
    if spread == 0:
        return torch.eye(len(weights), dtype=weights.dtype)
    kernel = (-torch.cdist(weights, weights).square() / (2 * spread**2)).exp()
    scale = torch.ones_like(kernel[0])
    for _ in range(1000):
        total = scale * (kernel @ scale)
        if (total - 1).abs().max() < 1e-9:
            break
        scale = scale / total.sqrt()
    return scale[:, None] * kernel * scale


def context_log_posterior(log_likelihood: Tensor, log_prior: Tensor, kernels: Tensor) -> Tensor:
    """Posterior of weights and rationality in every context; the sums are exact.

    A person has weights in general and a rationality; in a context, weights that resemble the general
    ones. How closely is not known: it is one of the kernels, the same for all contexts. Contexts know
    of each other through the general weights alone, so that sums over a tree give all marginals.

    Args:
        log_likelihood: of the answers in each context, ``[C, G, R]``.
        log_prior: of the rationality, ``[R]``; weights are uniform.
        kernels: of :func:`resemblance`, ``[M, G, G]``, equally likely.

    Returns:
        ``[C, G, R]``, log probabilities, normalized in each context.

    Example:
        With one context there is nothing to share: the posterior is the likelihood, normalized.

        >>> import torch
        >>> kernels = torch.eye(2)[None]
        >>> likelihood = torch.tensor([[[0.0], [1.0]]])
        >>> context_log_posterior(likelihood, torch.zeros(1), kernels).exp().flatten()
        tensor([0.2689, 0.7311])
    """
    if len(log_likelihood) == 1:
        return _normalized(log_likelihood + log_prior)
    to_general = _log_matmul(kernels[:, None], log_likelihood[None])  # [M, C, G, R]
    total = to_general.sum(1, keepdim=True)
    back = _log_matmul(kernels[:, None], total - to_general)
    return _normalized(log_likelihood + log_prior + back.logsumexp(0))


def _log_matmul(matrix: Tensor, log_values: Tensor) -> Tensor:
    """``log(matrix @ exp(log_values))``."""
    most = log_values.amax(-2, keepdim=True)
    return (matrix @ (log_values - most).exp()).clamp(min=1e-300).log() + most


def _normalized(log_values: Tensor) -> Tensor:
    return log_values - log_values.flatten(1).logsumexp(1)[:, None, None]
