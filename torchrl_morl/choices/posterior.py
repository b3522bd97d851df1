"""What is known of a person's weights after some choices."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from numpy.typing import ArrayLike
from torch import Tensor

from torchrl_morl.arguments import MOST_SEED, check_count, shown
from torchrl_morl.deploy.entries import parse_json
from torchrl_morl.preferences import PreferenceSpace

from .grid import Grid
from .model import Answer, Choice, ChoiceModel
from .particles import Particles

__all__ = ["PreferencePosterior"]

FORMAT = 1
LARGEST_GRID = 4
"""Objectives up to which sums over a grid are exact."""
LARGEST_SAMPLE = 1_000_000
"""Particles at most: they take 100 MB."""

_DIVISIONS = {1: 1, 2: 50, 3: 25, 4: 12}


class PreferencePosterior:
    """A posterior over what a person weighs, from choices between two alternatives.

    A person has a utility, ``weights . outcomes``, and answers as :class:`ChoiceModel` says. Weights
    are uniform on the simplex before the first answer. Up to four objectives the posterior is exact
    on a grid; beyond that it is sampled, see ``docs/how_to/choices.md``.

    In several contexts (a corridor, an open room) a person has weights for each. They resemble each
    other by an amount that is inferred as well, so that an answer in one context tells something about
    the others.

    These weights explain choices. What a policy should be given is another vector:
    :func:`~torchrl_morl.choices.best_preference`.

    Args:
        objectives: names, in the order of outcomes.
        contexts: names; one or more.
        model: how answers come about.
        divisions: of the grid along an edge; default 50, 25 and 12 for two, three and four objectives.
        particles: number of samples beyond four objectives.
        seed: of the samples.

    Raises:
        ValueError: for names that are missing or repeated, numbers out of range, or several contexts
            beyond four objectives.

    Example:
        >>> posterior = PreferencePosterior(("distance", "efficiency"))
        >>> for _ in range(3):
        ...     posterior.answer([1.0, -1.0], [-1.0, 1.0], "first")
        >>> posterior
        PreferencePosterior(3 answers; distance 0.80 ± 0.16, efficiency 0.20 ± 0.16)
        >>> posterior.undo().answer, posterior.num_answers
        ('first', 2)
    """

    def __init__(
        self,
        objectives: Sequence[str],
        *,
        contexts: Sequence[str] = ("everywhere",),
        model: ChoiceModel | None = None,
        divisions: int | None = None,
        particles: int = 4096,
        seed: int = 0,
    ) -> None:
        self.objectives = _names("objectives", objectives)
        self.contexts = _names("contexts", contexts)
        self.model = ChoiceModel() if model is None else model
        check_count("particles", particles, 2, LARGEST_SAMPLE)
        check_count("seed", seed, 0, MOST_SEED)
        size = len(self.objectives)
        self.exact = size <= LARGEST_GRID
        if not self.exact and len(self.contexts) > 1:
            raise ValueError(
                f"contexts {list(self.contexts)} need a grid, of at most {LARGEST_GRID} objectives; "
                f"here are {size}: keep one posterior a context."
            )
        if divisions is None:
            divisions = _DIVISIONS.get(size, 1)
        check_count("divisions", divisions, 1)
        self._settings = {"divisions": divisions, "particles": particles, "seed": seed}
        self._choices: list[Choice] = []
        self._belief: Grid | Particles
        if self.exact:
            lattice = PreferenceSpace(self.objectives).lattice(divisions).double()
            self._belief = Grid(lattice, self.contexts, self.model)
        else:
            self._belief = Particles(size, self.model, particles, seed)

    # --- answers

    @property
    def num_answers(self) -> int:
        """How many answers it holds."""
        return len(self._choices)

    @property
    def choices(self) -> tuple[Choice, ...]:
        """The answers, oldest first."""
        return tuple(self._choices)

    def answer(
        self,
        first: Tensor | ArrayLike,
        second: Tensor | ArrayLike,
        answer: Answer,
        context: str | None = None,
    ) -> None:
        """Take an answer in.

        Args:
            first: outcomes of the first alternative, ``[T]``, higher is better. In units in which
                differences of 1 are plain to see: see :func:`~torchrl_morl.choices.standardize`.
            second: of the second, ``[T]``.
            answer: ``"first"``, ``"second"``, ``"tie"`` or ``"neither"``.
            context: where; may be left out if there is one.

        Raises:
            ValueError: for other shapes, numbers that are not finite, an answer that is not offered,
                or a context that is none of its own. Nothing is taken in then.
        """
        if answer not in self.model.offered:
            raise ValueError(f"answer must be one of {self.model.offered}, got {answer!r}.")
        context = self.contexts[self.context_index(context)]
        outcomes = [self._alternative(*one) for one in (("first", first), ("second", second))]
        self._choices.append(Choice(*outcomes, answer, context))
        self._belief.observe(self._choices)

    def undo(self) -> Choice:
        """Forget the newest answer, and return it.

        Raises:
            ValueError: if there is none.
        """
        if not self._choices:
            raise ValueError("there is no answer to undo.")
        choice = self._choices.pop()
        self._belief.restart()
        for count in range(self.num_answers):
            self._belief.observe(self._choices[: count + 1])
        return choice

    # --- what is known

    @property
    def weights(self) -> Tensor:
        """Hypotheses about the weights, ``[H, T]``."""
        return self._belief.weights

    @property
    def rationality(self) -> Tensor:
        """Hypotheses about the rationality, ``[H]``."""
        return self._belief.rationality

    def probability(self, context: str | None = None) -> Tensor:
        """Posterior probability of every hypothesis in a context, ``[H]``.

        Args:
            context: may be left out if there is one.

        Raises:
            ValueError: for a context that is none of its own.
        """
        return self._belief.probability[self.context_index(context)]

    def mean(self, context: str | None = None) -> Tensor:
        """Mean of the weights, ``[T]``."""
        return self.probability(context) @ self.weights

    def deviation(self, context: str | None = None) -> Tensor:
        """Standard deviation of each weight, ``[T]``."""
        apart = (self.weights - self.mean(context)).square()
        return (self.probability(context) @ apart).sqrt()

    def chance(self, context: str | None = None) -> float:
        """Probability that the answers are chance: that the rationality is 0."""
        return float(self.probability(context)[self.rationality == 0].sum())

    def predict(
        self,
        first: Tensor | ArrayLike,
        second: Tensor | ArrayLike,
        context: str | None = None,
    ) -> Tensor:
        """Probabilities of the answers to questions that have not been asked.

        Args:
            first: outcomes, ``[*B, T]``.
            second: ``[*B, T]``.
            context: may be left out if there is one.

        Returns:
            ``[*B, 4]``, in the order of ``torchrl_morl.choices.ANSWERS``.

        Example:
            >>> posterior = PreferencePosterior(("distance", "efficiency"))
            >>> chances = posterior.predict([1.0, -1.0], [-1.0, 1.0])
            >>> bool(chances[0].isclose(chances[1]))
            True
        """
        size = len(self.objectives)
        alternatives = [_numbers("first", first), _numbers("second", second)]
        for name, values in zip(("first", "second"), alternatives, strict=True):
            if not values.ndim or values.shape[-1] != size:
                raise ValueError(
                    f"{name} must have shape [..., {size}] for {self.objectives}, got "
                    f"{list(values.shape)}."
                )
        utilities = [values @ self.weights.T for values in alternatives]
        chances = self.model.probabilities(*utilities, self.rationality)
        return (chances * self.probability(context)[:, None]).sum(-2)

    def context_index(self, context: str | None) -> int:
        """Place of a context in :attr:`contexts`.

        Raises:
            ValueError: if it is not there, or left out among several.
        """
        if context is None and len(self.contexts) == 1:
            return 0
        if context not in self.contexts:
            raise ValueError(f"context must be one of {self.contexts}, got {context!r}.")
        return self.contexts.index(context)

    def __repr__(self) -> str:
        count = f"{self.num_answers} answer{'s' * (self.num_answers != 1)}"
        parts = []
        for context in self.contexts:
            rows = zip(self.objectives, self.mean(context), self.deviation(context), strict=True)
            text = ", ".join(f"{name} {mean:.2f} ± {spread:.2f}" for name, mean, spread in rows)
            parts.append(text if len(self.contexts) == 1 else f"{context}: {text}")
        return f"{type(self).__name__}({'; '.join([count, *parts])})"

    # --- files

    def state_dict(self) -> dict[str, Any]:
        """Everything in values of JSON: the settings and the answers, from which the rest follows."""
        return {
            "format": FORMAT,
            "objectives": list(self.objectives),
            "contexts": list(self.contexts),
            "model": dataclasses.asdict(self.model),
            **self._settings,
            "choices": [dataclasses.asdict(choice) for choice in self._choices],
        }

    @classmethod
    def from_state_dict(cls, state: Mapping[str, Any]) -> PreferencePosterior:
        """The posterior that :meth:`state_dict` has described.

        Raises:
            ValueError: for anything else.

        Example:
            >>> posterior = PreferencePosterior(("distance", "efficiency"))
            >>> posterior.answer([1, 0], [0, 1], "tie")
            >>> PreferencePosterior.from_state_dict(posterior.state_dict()).num_answers
            1
        """
        try:
            if state["format"] != FORMAT:
                raise ValueError(f"its format is {state['format']!r}, not {FORMAT}")
            model = dict(state["model"])
            posterior = cls(
                state["objectives"],
                contexts=state["contexts"],
                model=ChoiceModel(**{**model, "rationalities": tuple(model["rationalities"])}),
                **{name: state[name] for name in ("divisions", "particles", "seed")},
            )
            for choice in state["choices"]:
                posterior.answer(**choice)
        except (KeyError, TypeError, ValueError) as error:
            reason = f"{error.args[0]!r} is missing" if isinstance(error, KeyError) else error
            raise ValueError(f"no state of a PreferencePosterior: {reason}") from error
        return posterior

    def save(self, path: str | Path) -> Path:
        """Write the state as JSON. A file of that name is replaced in one step.

        Args:
            path: the file; its folder must be there.
        """
        path = Path(path)
        partial = path.with_name(f"{path.name}.partial")
        partial.write_text(json.dumps(self.state_dict(), indent=1) + "\n")
        os.replace(partial, path)
        return path

    @classmethod
    def load(cls, path: str | Path) -> PreferencePosterior:
        """Read what :meth:`save` has written.

        Raises:
            ValueError: if it is something else.
        """
        try:
            return cls.from_state_dict(parse_json(Path(path).read_bytes(), "it"))
        except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
            raise ValueError(f"{path}: {error}") from error

    def _alternative(self, name: str, outcomes: Tensor | ArrayLike) -> tuple[float, ...]:
        values = _numbers(name, outcomes)
        if values.shape != (len(self.objectives),):
            raise ValueError(
                f"{name} must hold one outcome for each of {self.objectives}, got shape "
                f"{list(values.shape)}."
            )
        if not values.isfinite().all():
            raise ValueError(f"{name} must be finite, got {values.tolist()}.")
        return tuple(values.tolist())


def _numbers(name: str, values: Tensor | ArrayLike) -> Tensor:
    try:
        return torch.as_tensor(values).double()
    except (TypeError, RuntimeError, ValueError, OverflowError) as error:
        raise ValueError(f"{name} must hold numbers, got {shown(values)}.") from error


def _names(what: str, names: Sequence[str]) -> tuple[str, ...]:
    if isinstance(names, str):
        raise ValueError(f"{what} must be a sequence of names, got {names!r}.")
    names = tuple(names)
    if not names:
        raise ValueError(f"{what} must hold at least one name, got none.")
    for index, name in enumerate(names):
        if not isinstance(name, str) or not name:
            raise ValueError(f"{what}[{index}] must be a non-empty string, got {name!r}.")
        if name in names[:index]:
            raise ValueError(f"{what}[{index}] repeats {name!r}.")
    return names
