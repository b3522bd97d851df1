"""What to ask next: the two alternatives whose comparison tells most."""

from __future__ import annotations

import dataclasses

import torch
from numpy.typing import ArrayLike
from torch import Tensor

from torchrl_morl.arguments import check_count

from .outcomes import as_outcomes
from .posterior import PreferencePosterior

__all__ = ["Question", "information", "next_question"]

_NEGLIGIBLE = 1e-5
"""Share of the probability that hypotheses left out of a mutual information have together."""

_DRAWS = 4096
"""Pairs that are drawn at least."""

_CHUNK = 500_000
"""Probabilities that are computed at once."""


@dataclasses.dataclass(frozen=True)
class Question:
    """Two alternatives of one scene.

    Args:
        scene: its index.
        first: index of the first alternative.
        second: of the second.
        information: bits that the answer is expected to tell.
    """

    scene: int
    first: int
    second: int
    information: float


def information(
    posterior: PreferencePosterior,
    first: Tensor | ArrayLike,
    second: Tensor | ArrayLike,
    context: str | None = None,
) -> Tensor:
    """Mutual information between the answers to questions and the hypotheses, in bits.

    Bıyık et al. (https://arxiv.org/abs/1910.04365) choose questions by it: the answer is uncertain to
    us, and not to the person.

    Args:
        posterior: what is known.
        first: outcomes of first alternatives, ``[Q, T]``.
        second: of second ones, ``[Q, T]``.
        context: where; may be left out if there is one.

    Returns:
        ``[Q]``.

    Example:
        >>> posterior = PreferencePosterior(("distance", "efficiency"))
        >>> bits = information(posterior, [[1.0, -1.0], [1.0, 1.0]], [[-1.0, 1.0], [1.0, 1.0]])
        >>> bool(bits[0] > 0.1), bool(bits[1] < bits[0])
        (True, True)
    """
    sides = [torch.as_tensor(x).float() for x in (first, second)]
    probability = posterior.probability(context)
    order = probability.argsort(descending=True)
    kept = order[: int((probability[order].cumsum(0) < 1 - _NEGLIGIBLE).sum()) + 1]
    share = (probability[kept] / probability[kept].sum()).float()
    weights, rationality = posterior.weights[kept].float(), posterior.rationality[kept].float()
    rows = max(1, _CHUNK // len(kept))
    return torch.cat(
        [
            _bits(posterior, a @ weights.T, b @ weights.T, rationality, share)
            for a, b in zip(sides[0].split(rows), sides[1].split(rows), strict=True)
        ]
    )


def next_question(
    posterior: PreferencePosterior,
    outcomes: Tensor | ArrayLike,
    *,
    context: str | None = None,
    valid: Tensor | None = None,
    candidates: int = 1000,
    generator: torch.Generator | None = None,
) -> Question:
    """The most informative of some questions that are drawn at random.

    Which of the two alternatives is the first one is drawn, too: someone who always takes the first
    says nothing by it.

    Args:
        posterior: what is known.
        outcomes: ``[S, P, T]``: of ``P`` alternatives in each of ``S`` scenes.

    Keyword Args:
        context: where; may be left out if there is one.
        valid: which alternatives may be shown, ``[S, P]``. Default: all.
        candidates: how many questions are compared.
        generator: the source of randomness.

    Raises:
        ValueError: for other shapes, or if no pair that is drawn may be shown and differs.

    Example:
        >>> posterior = PreferencePosterior(("distance", "efficiency"))
        >>> outcomes = [[[1.0, -1.0], [1.0, -1.0], [-1.0, 1.0]]]
        >>> question = next_question(
        ...     posterior, outcomes, generator=torch.Generator().manual_seed(0)
        ... )
        >>> question.scene, {question.first, question.second} in ({0, 2}, {1, 2})
        (0, True)
    """
    check_count("candidates", candidates)
    values = as_outcomes(outcomes, len(posterior.objectives))
    if values.ndim != 3:
        raise ValueError(f"outcomes must have shape [S, P, T], got {list(values.shape)}.")
    scenes, count = values.shape[:2]
    # More than are needed, since some pairs are of one alternative or may not be shown.
    shape = (max(4 * candidates, _DRAWS),)
    scene = torch.randint(scenes, shape, generator=generator)
    first = torch.randint(count, shape, generator=generator)
    second = torch.randint(count, shape, generator=generator)
    usable = (values[scene, first] != values[scene, second]).any(-1)
    if valid is not None:
        usable &= valid[scene, first] & valid[scene, second]
    rows = usable.nonzero().squeeze(-1)[:candidates]
    if not len(rows):
        raise ValueError(
            f"outcomes: of {len(usable):,} pairs that were drawn, no two alternatives that may be shown "
            "differ."
        )
    scene, first, second = scene[rows], first[rows], second[rows]
    bits = information(posterior, values[scene, first], values[scene, second], context)
    best = int(bits.argmax())
    return Question(int(scene[best]), int(first[best]), int(second[best]), float(bits[best]))


def _bits(
    posterior: PreferencePosterior,
    first: Tensor,
    second: Tensor,
    rationality: Tensor,
    share: Tensor,
) -> Tensor:
    total = torch.zeros(len(first))
    for chance in posterior.model.by_answer(first, second, rationality):
        overall = chance @ share
        # What is not offered has no chance, and tells nothing.
        total += torch.special.xlogy(chance, chance) @ share - torch.special.xlogy(overall, overall)
    return total.clamp(min=0) / torch.tensor(2.0).log()
