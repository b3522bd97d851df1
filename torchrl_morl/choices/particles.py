"""Sampled inference, where a grid would be too large: particles that are reweighed and moved."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

__all__ = ["Particles"]

_MOVES = 8
_STEP = 0.6

LogLikelihood = Callable[[Tensor, Tensor], Tensor]
"""From weights ``[N, T]`` and rationality ``[N]`` to the log likelihood ``[N]`` of all answers."""


class Particles:
    """Iterated batch importance sampling (Chopin 2002) of weights and rationality.

    An answer reweighs the particles. When less than half of them count, they are drawn anew by
    weight and moved by Metropolis steps, which leave the posterior as it is.

    Args:
        num_objectives: entries of the weights, uniform on the simplex before the first answer.
        rationalities: probabilities of its values.
        size: number of particles.
        seed: of the draws; the same answers give the same particles.
    """

    def __init__(
        self, num_objectives: int, rationalities: dict[float, float], size: int, seed: int
    ) -> None:
        self._generator = torch.Generator().manual_seed(seed)
        self._values = torch.tensor(list(rationalities), dtype=torch.float64)
        self._prior = torch.tensor(list(rationalities.values()), dtype=torch.float64)
        shape = (size, num_objectives)
        # Exponential variables divided by their sum are uniform on the simplex.
        self._raw = torch.empty(shape, dtype=torch.float64).exponential_(generator=self._generator)
        self._which = torch.multinomial(
            self._prior, size, replacement=True, generator=self._generator
        )
        self.log_weight = torch.zeros(size, dtype=torch.float64) - torch.tensor(float(size)).log()

    @property
    def weights(self) -> Tensor:
        """``[N, T]``, on the simplex."""
        return self._raw / self._raw.sum(-1, keepdim=True)

    @property
    def rationality(self) -> Tensor:
        """``[N]``."""
        return self._values[self._which]

    @property
    def effective_size(self) -> float:
        """How many equally weighed particles they are worth."""
        return float((-(2 * self.log_weight).logsumexp(0)).exp())

    def update(self, newest: LogLikelihood, every: LogLikelihood) -> None:
        """Take an answer in.

        Args:
            newest: what this answer adds to the log likelihood.
            every: the log likelihood of all answers, this one included.
        """
        self.log_weight = self.log_weight + newest(self.weights, self.rationality)
        self.log_weight = self.log_weight - self.log_weight.logsumexp(0)
        if self.effective_size < len(self.log_weight) / 2:
            self._resample()
            self._move(every)

    def _resample(self) -> None:
        size = len(self.log_weight)
        # Systematic: one random number, and the smallest variance.
        offset = torch.rand((), generator=self._generator, dtype=torch.float64)
        places = (torch.arange(size, dtype=torch.float64) + offset) / size
        total = self.log_weight.exp().cumsum(0)
        rows = torch.searchsorted(total / total[-1], places).clamp(max=size - 1)
        self._raw, self._which = self._raw[rows], self._which[rows]
        self.log_weight = torch.full_like(self.log_weight, -float(torch.tensor(size).log()))

    def _move(self, every: LogLikelihood) -> None:
        def log_target(raw: Tensor, which: Tensor) -> Tensor:
            weights = raw / raw.sum(-1, keepdim=True)
            # Exponential density times the change of variables to its logarithm.
            prior = (raw.log() - raw).sum(-1) + self._prior[which].log()
            return prior + every(weights, self._values[which])

        generator, size = self._generator, len(self.log_weight)
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
