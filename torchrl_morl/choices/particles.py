"""Sampled inference, where a grid would be too large: particles that are reweighed and moved."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from .model import Choice, ChoiceModel

__all__ = ["Particles"]

_MOVES = 8
_STEP = 0.6


class Particles:
    """Iterated batch importance sampling (Chopin 2002) of weights and rationality.

    An answer reweighs the particles. When less than half of them count, they are drawn anew by
    weight and moved by Metropolis steps, which leave the posterior as it is.

    Args:
        num_objectives: entries of the weights, uniform on the simplex before the first answer.
        model: how answers come about.
        size: number of particles.
        seed: of the draws; the same answers give the same particles.
    """

    def __init__(self, num_objectives: int, model: ChoiceModel, size: int, seed: int) -> None:
        self._model, self._shape, self._seed = model, (size, num_objectives), seed
        self._values = torch.tensor(list(model.prior), dtype=torch.float64)
        self._prior = torch.tensor(list(model.prior.values()), dtype=torch.float64)
        self.restart()

    def restart(self) -> None:
        """Draw the particles of before the first answer."""
        size = self._shape[0]
        self._generator = torch.Generator().manual_seed(self._seed)
        # Exponential variables divided by their sum are uniform on the simplex.
        self._raw = torch.empty(self._shape, dtype=torch.float64)
        self._raw.exponential_(generator=self._generator)
        self._which = torch.multinomial(
            self._prior, size, replacement=True, generator=self._generator
        )
        self._log_weight = torch.full((size,), -math.log(size), dtype=torch.float64)

    @property
    def weights(self) -> Tensor:
        """``[N, T]``, on the simplex."""
        return self._raw / self._raw.sum(-1, keepdim=True)

    @property
    def rationality(self) -> Tensor:
        """``[N]``."""
        return self._values[self._which]

    @property
    def probability(self) -> Tensor:
        """In the one context, ``[1, N]``."""
        return self._log_weight.exp()[None]

    @property
    def effective_size(self) -> float:
        """How many equally weighed particles they are worth."""
        return float((-(2 * self._log_weight).logsumexp(0)).exp())

    def observe(self, choices: Sequence[Choice]) -> None:
        """Take in the last of all answers."""
        # Not its own likelihood alone: the older answers count less from now on.
        every = self._log_likelihood(choices, self.weights, self.rationality)
        older = self._log_likelihood(choices[:-1], self.weights, self.rationality)
        log_weight = self._log_weight + every - older
        self._log_weight = log_weight - log_weight.logsumexp(0)
        if self.effective_size < len(log_weight) / 2:
            self._resample()
            self._move(choices)

    def _log_likelihood(
        self, choices: Sequence[Choice], weights: Tensor, rationality: Tensor
    ) -> Tensor:
        return self._model.log_likelihood(choices, weights, rationality).sum(0)

    def _resample(self) -> None:
        size = len(self._log_weight)
        # Systematic: one random number, and the smallest variance.
        offset = torch.rand((), generator=self._generator, dtype=torch.float64)
        places = (torch.arange(size, dtype=torch.float64) + offset) / size
        total = self._log_weight.exp().cumsum(0)
        rows = torch.searchsorted(total / total[-1], places).clamp(max=size - 1)
        self._raw, self._which = self._raw[rows], self._which[rows]
        self._log_weight = torch.full_like(self._log_weight, -math.log(size))

    def _move(self, choices: Sequence[Choice]) -> None:
        def log_target(raw: Tensor, which: Tensor) -> Tensor:
            weights = raw / raw.sum(-1, keepdim=True)
            # Exponential density times the change of variables to its logarithm.
            prior = (raw.log() - raw).sum(-1) + self._prior[which].log()
            return prior + self._log_likelihood(choices, weights, self._values[which])

        generator, size = self._generator, len(self._log_weight)
        before = log_target(self._raw, self._which)
        for _ in range(_MOVES):
            noise = torch.randn(self._raw.shape, generator=generator, dtype=torch.float64)
            raw = self._raw * (_STEP * noise).exp()
            which = torch.randint(len(self._values), (size,), generator=generator)
            keep = torch.rand(size, generator=generator) < 0.5
            which = torch.where(keep, self._which, which)
            after = log_target(raw, which)
            draw = torch.rand(size, generator=generator, dtype=torch.float64).log()
            taken = draw < after - before
            self._raw = torch.where(taken[:, None], raw, self._raw)
            self._which = torch.where(taken, which, self._which)
            before = torch.where(taken, after, before)
