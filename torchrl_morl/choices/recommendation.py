"""What to give a policy: the preference whose outcomes are best under all that is known."""

from __future__ import annotations

import dataclasses

import torch
from numpy.typing import ArrayLike
from torch import Tensor

from .outcomes import finite_outcomes
from .posterior import PreferencePosterior

__all__ = ["Recommendation", "best_preference"]


@dataclasses.dataclass(frozen=True)
class Recommendation:
    """A preference, and how sure it is.

    Args:
        preference: ``[T]``, to be given to the policy.
        index: its row among the preferences that were driven.
        satisfaction: expected utility of every preference, ``[P]``: 1 for what a person likes best of
            all that this policy does, 0 for what they like least.
        regret: what the preference is expected to miss of the best one, from 0 to 1.
        regret_high: what it misses at most, with a probability of 90 %.
        chance: probability that the answers say nothing.
    """

    preference: Tensor
    index: int
    satisfaction: Tensor
    regret: float
    regret_high: float
    chance: float

    def __str__(self) -> str:
        entries = ", ".join(f"{value:.2f}" for value in self.preference.tolist())
        return (
            f"({entries}), expected regret {100 * self.regret:.1f} %, "
            f"below {100 * self.regret_high:.0f} % with a probability of 90 %"
        )


def best_preference(
    posterior: PreferencePosterior,
    outcomes: Tensor | ArrayLike,
    preferences: Tensor | ArrayLike,
    *,
    context: str | None = None,
) -> Recommendation:
    """The preference of greatest expected utility over the policy's own rollouts.

    Not the mean of the weights: a policy follows a weight in its own way, and what it does under a
    preference is known from its rollouts. The utility of a hypothesis is measured from the least to
    the most that any preference reaches, since utilities of different people have no common unit.

    Args:
        posterior: what is known of the person.
        outcomes: ``[*S, P, T]``: in every scene, one row a preference.
        preferences: ``[P, T']``, what was commanded.

    Keyword Args:
        context: where; may be left out if there is one.

    Raises:
        ValueError: for shapes that do not fit.

    Example:
        >>> posterior = PreferencePosterior(("distance", "efficiency"))
        >>> posterior.answer([1.0, -1.0], [0.0, 0.5], "second")
        >>> posterior.answer([0.0, 0.5], [-1.0, 1.0], "first")
        >>> outcomes = [[1.0, -1.2], [0.4, 0.4], [-1.4, 0.8]]
        >>> best = best_preference(posterior, outcomes, [[1, 0], [0.5, 0.5], [0, 1]])
        >>> best.index, best.preference.tolist(), best.regret < best.regret_high
        (1, [0.5, 0.5], True)
    """
    values = finite_outcomes(outcomes, len(posterior.objectives))
    rows = torch.as_tensor(preferences)
    if rows.ndim != 2 or len(rows) != values.shape[-2]:
        raise ValueError(
            f"preferences must have shape [{values.shape[-2]}, T], one row an alternative, got "
            f"{list(rows.shape)}."
        )
    scaled, mean = in_satisfaction(posterior.weights, values)
    utility = scaled @ mean.T  # [H, P]
    satisfied = 1 + utility - utility.amax(-1, keepdim=True)
    probability = posterior.probability(context)
    satisfaction = probability @ satisfied
    index = int(satisfaction.argmax())
    missed = 1 - satisfied[:, index]
    order = missed.argsort()
    place = int((probability[order].cumsum(0) < 0.9).sum())
    return Recommendation(
        preference=rows[index],
        index=index,
        satisfaction=satisfaction,
        regret=float(1 - satisfaction[index]),
        regret_high=float(missed[order[min(place, len(order) - 1)]]),
        chance=posterior.chance(context),
    )


def in_satisfaction(weights: Tensor, outcomes: Tensor) -> tuple[Tensor, Tensor]:
    """Weights in the unit of the way from the worst preference to the best, and mean outcomes.

    The satisfaction of a hypothesis with a preference is their product, up to a number of the hypothesis.

    Args:
        weights: hypotheses, ``[H, T]``.
        outcomes: ``[*S, P, T]``.

    Returns:
        Weights, ``[H, T]``: 0 for hypotheses to which all preferences are alike, since none is missed
        then. Mean outcomes of each preference, ``[P, T]``.
    """
    mean = outcomes.to(weights).reshape(-1, *outcomes.shape[-2:]).mean(0)
    utility = weights @ mean.T
    way = utility.amax(-1, keepdim=True) - utility.amin(-1, keepdim=True)
    return torch.where(way > 0, weights / way.clamp(min=1e-12), 0.0), mean
