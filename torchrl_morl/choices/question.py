"""What to ask next: the two alternatives whose comparison improves the recommendation most."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator

import torch
from numpy.typing import ArrayLike
from torch import Tensor

from torchrl_morl.arguments import check_count, is_number

from .outcomes import finite_outcomes
from .posterior import PreferencePosterior
from .recommendation import in_satisfaction

__all__ = ["Question", "information", "next_question", "value_of_information"]

_NEGLIGIBLE = 1e-5
"""Share of the probability that hypotheses left out of a sum have together."""

_BIT = 0.01
"""Satisfaction that a bit is worth. Often no single answer changes the choice: then bits decide."""

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
        value: what the answer is expected to add to the satisfaction with the recommended preference,
            from 0 to 1: see :func:`value_of_information`.
        information: bits that the answer is expected to tell: see :func:`information`.
    """

    scene: int
    first: int
    second: int
    value: float
    information: float

    @property
    def worth(self) -> float:
        """What questions are compared by: the value, and a hundredth of each bit."""
        return self.value + _BIT * self.information


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
    kept, share = _likely(posterior, context)
    parts = _chances(posterior, first, second, kept)
    return torch.cat([_bits(chances, share) for chances in parts])


def value_of_information(
    posterior: PreferencePosterior,
    first: Tensor | ArrayLike,
    second: Tensor | ArrayLike,
    outcomes: Tensor | ArrayLike,
    context: str | None = None,
) -> Tensor:
    """What the answers to questions are expected to add to the satisfaction with the recommendation.

    The preference that :func:`~torchrl_morl.choices.best_preference` gives after the answer, against the
    one that it gives now. Viappiani and Boutilier
    (https://proceedings.neurips.cc/paper/2010/hash/550a141f12de6341fba65b0ad0433500-Abstract.html) choose
    questions by it: of what is unknown, they ask about what changes the choice.

    Args:
        posterior: what is known.
        first: outcomes of first alternatives, ``[Q, T]``.
        second: of second ones, ``[Q, T]``.
        outcomes: what the recommendation is made of, ``[*S, P, T]``.
        context: where; may be left out if there is one.

    Returns:
        ``[Q]``, from 0 to 1: shares of the way from the worst preference to the best. 0 for a question that
        cannot change the choice.

    Raises:
        ValueError: for outcomes of another shape.

    Example:
        One of two preferences is to be given. To compare their drives helps; to compare two drives
        that are alike to everybody does not.

        >>> posterior = PreferencePosterior(("distance", "efficiency"))
        >>> first, second = [[1.0, -1.0], [0.0, 0.0]], [[-1.0, 1.0], [0.0, 0.0]]
        >>> value = value_of_information(posterior, first, second, [[1.0, -1.0], [-1.0, 1.0]])
        >>> bool(value[0] > 0.1), bool(value[1].abs() < 1e-12)
        (True, True)
    """
    kept, share = _likely(posterior, context)
    # The satisfaction of a hypothesis is linear in mean outcomes: sums over hypotheses are taken first.
    values = finite_outcomes(outcomes, len(posterior.objectives))
    reached = in_satisfaction(posterior.weights[kept], values)
    parts = _chances(posterior, first, second, kept)
    return torch.cat([_gain(chances, share, *reached) for chances in parts])


def next_question(
    posterior: PreferencePosterior,
    outcomes: Tensor | ArrayLike,
    *,
    context: str | None = None,
    valid: Tensor | None = None,
    candidates: int = 500,
    typical: float = 0.3,
    generator: torch.Generator | None = None,
) -> Question:
    """The most valuable of some typical questions that are drawn at random.

    Two preferences are shown in one scene, and the answer is to tell about all scenes. A question is typical
    if its two outcomes differ as those of the two preferences do on average. Where the model of a
    person is wrong, an answer about other questions misleads most.

    The value is that of :func:`value_of_information`. Often no single answer changes the choice; so a bit of
    :func:`information` counts as well, as much as a hundredth of the satisfaction.

    Which of the two alternatives is the first one is drawn, too: someone who always takes the first
    says nothing by it.

    Args:
        posterior: what is known.
        outcomes: ``[S, P, T]``: of ``P`` preferences in each of ``S`` scenes, as of
            :func:`~torchrl_morl.choices.best_preference`.

    Keyword Args:
        context: where; may be left out if there is one.
        valid: which alternatives may be shown, ``[S, P]``. Default: all.
        candidates: how many questions are compared.
        typical: share of the questions that are drawn which are compared, the most typical ones, in
            ``(0, 1]``; 1 for any question.
        generator: the source of randomness.

    Raises:
        ValueError: for other shapes, a share out of its range, or if no pair that is drawn may be shown and differs.

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
    if not (is_number(typical) and 0 < typical <= 1):
        raise ValueError(f"typical must be above 0 and at most 1, got {typical!r}.")
    values = finite_outcomes(outcomes, len(posterior.objectives))
    if values.ndim != 3:
        raise ValueError(f"outcomes must have shape [S, P, T], got {list(values.shape)}.")
    scenes, count = values.shape[:2]
    drawn = int(candidates / typical)
    # More than are needed, since some pairs are of one alternative or may not be shown.
    shape = (max(2 * drawn, _DRAWS),)
    scene = torch.randint(scenes, shape, generator=generator)
    first = torch.randint(count, shape, generator=generator)
    second = torch.randint(count, shape, generator=generator)
    usable = (values[scene, first] != values[scene, second]).any(-1)
    if valid is not None:
        usable &= valid[scene, first] & valid[scene, second]
    rows = usable.nonzero().squeeze(-1)[:drawn]
    if not len(rows):
        raise ValueError(
            f"outcomes: of {len(usable):,} pairs that were drawn, no two alternatives that may be shown "
            "differ."
        )
    unlike = _unlike(values.double(), scene[rows], first[rows], second[rows])
    # In the order of the draws again, so that of equal questions the first is taken.
    nearest = unlike.argsort(stable=True)[: math.ceil(typical * len(rows))].sort().values
    rows = rows[nearest[:candidates]]
    scene, first, second = scene[rows], first[rows], second[rows]
    kept, share = _likely(posterior, context)
    reached = in_satisfaction(posterior.weights[kept], values)
    gains, bits = [], []
    for chances in _chances(posterior, values[scene, first], values[scene, second], kept):
        gains.append(_gain(chances, share, *reached))
        bits.append(_bits(chances, share))
    value, told = torch.cat(gains), torch.cat(bits)
    best = int((value + _BIT * told).argmax())
    return Question(
        scene=int(scene[best]),
        first=int(first[best]),
        second=int(second[best]),
        value=float(value[best]),
        information=float(told[best]),
    )


def _unlike(values: Tensor, scene: Tensor, first: Tensor, second: Tensor) -> Tensor:
    """How far the differences in a scene are from the average ones, from 0 to 1."""
    here = values[scene, first] - values[scene, second]
    mean = values.mean(0)
    everywhere = mean[first] - mean[second]
    return (here - everywhere).norm(dim=-1) / (here.norm(dim=-1) + everywhere.norm(dim=-1))


def _likely(posterior: PreferencePosterior, context: str | None) -> tuple[Tensor, Tensor]:
    """Hypotheses that have nearly all of the probability, ``[K]``, and their shares of it, ``[K]``."""
    probability = posterior.probability(context)
    order = probability.argsort(descending=True, stable=True)
    kept = order[: int((probability[order].cumsum(0) < 1 - _NEGLIGIBLE).sum()) + 1]
    return kept, probability[kept] / probability[kept].sum()


def _chances(
    posterior: PreferencePosterior,
    first: Tensor | ArrayLike,
    second: Tensor | ArrayLike,
    kept: Tensor,
) -> Iterator[Tensor]:
    """Probabilities of the answers under some hypotheses, ``[4, q, K]``, of some questions at a time."""
    weights, rationality = posterior.weights[kept], posterior.rationality[kept]
    rows = max(1, _CHUNK // len(kept))
    sides = [torch.as_tensor(x).double().split(rows) for x in (first, second)]
    for one, other in zip(*sides, strict=True):
        yield posterior.model.by_answer(one @ weights.T, other @ weights.T, rationality)


def _bits(chances: Tensor, share: Tensor) -> Tensor:
    overall = chances @ share
    # What is not offered has no chance, and tells nothing.
    told = torch.special.xlogy(chances, chances) @ share - torch.special.xlogy(overall, overall)
    return told.sum(0).clamp(min=0) / math.log(2)


def _gain(chances: Tensor, share: Tensor, scaled: Tensor, mean: Tensor) -> Tensor:
    after = chances @ (share[:, None] * scaled)  # [4, q, T]
    now = (share @ scaled @ mean.T).max()
    return ((after @ mean.T).amax(-1).sum(0) - now).clamp(min=0)
