"""Exact inference on a grid of weights, for one context or for several that resemble each other."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from .model import Choice, ChoiceModel

__all__ = ["Grid", "context_log_posterior", "resemblance"]

_SPREADS = (0.0, 0.2, 0.6)


class Grid:
    """Weights on a lattice of the simplex, times rationalities: all sums over them are exact.

    Args:
        lattice: weights, equally likely before the first answer, ``[G, T]``.
        contexts: names.
        model: how answers come about.
    """

    def __init__(self, lattice: Tensor, contexts: Sequence[str], model: ChoiceModel) -> None:
        values = torch.tensor(list(model.prior), dtype=torch.float64)
        self._contexts, self._model = contexts, model
        self._log_prior = torch.tensor(list(model.prior.values()), dtype=torch.float64).log()
        self.weights = lattice.repeat_interleave(len(values), 0)
        """``[H, T]``, ``H`` = ``G`` times the number of rationalities."""
        self.rationality = values.repeat(len(lattice))
        """``[H]``."""
        # One context has nothing to resemble.
        spreads = _SPREADS if len(contexts) > 1 else _SPREADS[:1]
        self._kernels = torch.stack([resemblance(lattice, one) for one in spreads])
        self.restart()

    def restart(self) -> None:
        """Go back to before the first answer."""
        self.observe(())

    def observe(self, choices: Sequence[Choice]) -> None:
        """Take in all answers, oldest first."""
        each = self._model.log_likelihood(choices, self.weights, self.rationality)
        rows = torch.tensor(
            [self._contexts.index(choice.context) for choice in choices], dtype=torch.long
        )
        total = self.weights.new_zeros(len(self._contexts), len(self.weights))
        total.index_add_(0, rows, each)
        shaped = total.view(len(total), -1, len(self._log_prior))
        log_posterior = context_log_posterior(shaped, self._log_prior, self._kernels)
        self.probability = log_posterior.exp().flatten(1)
        """In every context, ``[C, H]``."""


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
