"""Trials of ways to find a preference, on one simulated person each."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor
from torch.nn.functional import logsigmoid

from torchrl_morl.choices import Answer, PreferencePosterior, best_preference, next_question
from torchrl_morl.preferences import PreferenceSpace

from .people import OBJECTIVES, Drives, Person, in_units, units_of

AFTER = (0, 1, 3, 5, 10, 20)
"""Numbers of answers after which the regret is taken."""

CANDIDATES = 150


@dataclasses.dataclass(frozen=True)
class Place:
    """Scenes of one kind: those of the questions and those that nobody has seen.

    Args:
        outcomes: of the model in the first, ``[S, P, T]``.
        valid: which drives may be shown, ``[S, P]``.
        preferences: ``[P, T]``.
        known: what people notice of the first.
        unseen: what they notice of the others.
    """

    outcomes: Tensor
    valid: Tensor
    preferences: Tensor
    known: Drives
    unseen: Drives


@dataclasses.dataclass(frozen=True)
class Trial:
    """What happened with one person.

    Args:
        regret: by way, after each of :data:`AFTER`, shares of what the policy can do for them.
        claimed: what the model expected of its own, ``[len(AFTER)]``.
        claimed_high: the bound that it gave with 90 %.
        predicted: probability that the first is liked better, of each question before its answer.
        happened: whether it was, one a question; questions without a better one are left out.
    """

    regret: dict[str, list[float]]
    claimed: list[float]
    claimed_high: list[float]
    predicted: list[float]
    happened: list[bool]


class Mind:
    """What a person feels about the drives of a place, before and after a change of mind."""

    def __init__(self, person: Person, place: Place) -> None:
        units = units_of(person.kind, place.known)
        # Twice the same for those who keep their mind.
        moments = (0, max(AFTER) + 1)
        self._person, self._preferences = person, place.preferences
        self._felt = [in_units(person.utility(place.known, units, one)) for one in moments]
        self._unseen = [person.utility(place.unseen, units, one).mean(0) for one in moments]

    def felt(self, answers: int) -> Tensor:
        """Utilities of the drives that are asked about, ``[S, P]``, after so many answers."""
        return self._felt[self._person.changed(answers)]

    def regret(self, preference: Tensor, answers: int) -> float:
        """What a preference misses in unseen scenes: 0 for the best for the person, 1 for the worst."""
        return self._regret(int((self._preferences - preference).norm(dim=-1).argmin()), answers)

    def floor(self, answers: int) -> float:
        """The regret of what is best in the known scenes by what the person really feels."""
        return self._regret(int(self.felt(answers).mean(0).argmax()), answers)

    def _regret(self, index: int, answers: int) -> float:
        mean = self._unseen[self._person.changed(answers)]
        return float((mean.max() - mean[index]) / (mean.max() - mean.min()))


def ask(
    posterior: PreferencePosterior,
    person: Person,
    mind: Mind,
    place: Place,
    answers: int,
    generator: torch.Generator,
    *,
    informative: bool = True,
    context: str | None = None,
) -> tuple[float, Answer]:
    """Ask a person one question, and tell the posterior.

    Args:
        posterior: what is known.
        person: who is asked.
        mind: what they feel.
        place: where.
        answers: how many they have given, in all places.
        generator: the source of randomness.

    Keyword Args:
        informative: a question of :func:`~torchrl_morl.choices.next_question`, or a random one.
        context: of the place; may be left out if there is one.

    Returns:
        How likely it was, of the two, that the first is liked better; what was said.
    """
    # A random question is the only one that is compared.
    how = {"candidates": CANDIDATES} if informative else {"candidates": 1, "typical": 1.0}
    question = next_question(
        posterior,
        place.outcomes,
        context=context,
        valid=place.valid,
        generator=generator,
        **how,
    )
    pair = place.outcomes[question.scene, [question.first, question.second]]
    first, second = posterior.predict(*pair, context)[:2].tolist()
    utility = mind.felt(answers)[question.scene]
    answer = person.answer(utility, question.first, question.second, generator)
    posterior.answer(*pair, answer, context)
    return first / (first + second), answer


def asked(person: Person, mind: Mind, place: Place, seed: int, *, informative: bool) -> Trial:
    """Ask twenty questions, the most valuable ones or random ones.

    Keyword Args:
        informative: the first.
    """
    generator = torch.Generator().manual_seed(seed)
    posterior = PreferencePosterior(OBJECTIVES)
    ways: dict[str, list[float]] = {"best": [], "weights": []}
    trial = Trial(ways, [], [], [], [])
    for answers in range(max(AFTER) + 1):
        if answers in AFTER:
            best = best_preference(posterior, place.outcomes, place.preferences)
            trial.claimed.append(best.regret)
            trial.claimed_high.append(best.regret_high)
            ways["best"].append(mind.regret(best.preference, answers))
            ways["weights"].append(mind.regret(posterior.mean(), answers))
        if answers == max(AFTER):
            break
        predicted, answer = ask(
            posterior, person, mind, place, answers, generator, informative=informative
        )
        if answer in ("first", "second"):
            trial.predicted.append(predicted)
            trial.happened.append(answer == "first")
    return trial


def compared(person: Person, mind: Mind, place: Place, seed: int, *, scenes: int) -> list[float]:
    """Comparison of trajectories after Promptable Behaviors (https://arxiv.org/abs/2312.09337).

    Rebuilt from its abstract and what is known of it; the full paper was not read, and its release has
    no code of comparisons. Random pairs; the weights of greatest likelihood under Bradley-Terry, given
    to the policy as they are. Pairs, the grid that is searched and the unit of outcomes are ours.

    Keyword Args:
        scenes: that each side of a pair is shown in; more than one is their comparison of groups.

    Returns:
        Regret after each of :data:`AFTER`.
    """
    generator = torch.Generator().manual_seed(seed)
    lattice = PreferenceSpace(OBJECTIVES).lattice(25)
    scales = torch.tensor([0.5, 1.0, 2.0, 4.0, 8.0])[:, None]
    likelihood = torch.zeros(len(scales), len(lattice))
    found = []
    count, pairs = place.outcomes.shape[:2]
    for answers in range(max(AFTER) + 1):
        if answers in AFTER:
            # Many are equally likely at first: their middle.
            most = (likelihood >= likelihood.max() - 1e-4).any(0)
            found.append(mind.regret(lattice[most].mean(0), answers))
        if answers == max(AFTER):
            break
        rows = torch.randint(count, (scenes,), generator=generator)
        first, second = torch.randperm(pairs, generator=generator)[:2].tolist()
        utility = mind.felt(answers)[rows].mean(0)
        answer = person.answer(utility, first, second, generator)
        if answer not in ("first", "second"):
            continue
        difference = (place.outcomes[rows, first] - place.outcomes[rows, second]).mean(0)
        sign = 1.0 if answer == "first" else -1.0
        likelihood += logsigmoid(sign * scales * (lattice @ difference))
    return found


def stated(person: Person, mind: Mind, seed: int, *, error: float) -> float:
    """Regret of the weights that a person says, given to the policy.

    Keyword Args:
        error: see :meth:`~recipes.choices.people.Person.stated`.
    """
    weights = person.stated(torch.Generator().manual_seed(seed), error=error)
    return mind.regret(weights.float(), 0)


def in_contexts(
    people: dict[str, Person], places: dict[str, Place], seed: int, *, sharing: str
) -> list[float]:
    """Mean regret over contexts, each asked about in turn, by a person with weights in each.

    Keyword Args:
        sharing: ``"one"`` preference for all contexts, ``"separate"`` ones, or ``"hierarchical"``.

    Returns:
        Mean over contexts after each of :data:`AFTER`, answers of all contexts together.
    """
    generator = torch.Generator().manual_seed(seed)
    minds = {name: Mind(people[name], place) for name, place in places.items()}
    names = tuple(places)
    if sharing == "hierarchical":
        shared = PreferencePosterior(OBJECTIVES, contexts=names)
        known = {name: (shared, name) for name in names}
    elif sharing == "one":
        known = dict.fromkeys(names, (PreferencePosterior(OBJECTIVES), None))
    else:
        known = {name: (PreferencePosterior(OBJECTIVES), None) for name in names}
    found = []
    for answers in range(max(AFTER) + 1):
        if answers in AFTER:
            each = []
            for name, place in places.items():
                posterior, context = known[name]
                best = best_preference(
                    posterior, place.outcomes, place.preferences, context=context
                )
                each.append(minds[name].regret(best.preference, answers))
            found.append(sum(each) / len(each))
        if answers == max(AFTER):
            break
        name = names[answers % len(names)]
        posterior, context = known[name]
        person, mind = people[name], minds[name]
        ask(posterior, person, mind, places[name], answers, generator, context=context)
    return found
