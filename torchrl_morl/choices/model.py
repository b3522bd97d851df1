"""How a person answers: Bradley-Terry with rationality and slips, ties, and "neither"."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Literal, get_args

import torch
from torch import Tensor

from torchrl_morl.arguments import is_number

__all__ = ["ANSWERS", "Answer", "Choice", "ChoiceModel"]

Answer = Literal["first", "second", "tie", "neither"]

ANSWERS: tuple[Answer, ...] = get_args(Answer)
"""What can be said of two alternatives, in the order of probabilities."""


@dataclasses.dataclass(frozen=True)
class Choice:
    """An answer to one question.

    Args:
        first: outcomes of the first alternative, one an objective.
        second: of the second.
        answer: what was said.
        context: where.
    """

    first: tuple[float, ...]
    second: tuple[float, ...]
    answer: Answer
    context: str


@dataclasses.dataclass(frozen=True)
class ChoiceModel:
    """Probabilities of the answers to "which of the two do you like better?".

    A multinomial logit. With utilities ``u`` of the first and ``v`` of the second alternative, and
    rationality ``b``, the odds of the answers are

    ===========  =================================================================================
    ``first``    ``exp(b u)``
    ``second``   ``exp(b v)``, so that first against second is Bradley and Terry's (1952) model
    ``tie``      ``tie * exp(b (u + v) / 2)``, as of Davidson (1970)
    ``neither``  ``neither * exp(b 0)``: something else, of the average utility, which is 0 where
                 outcomes are standardized
    ===========  =================================================================================

    A share ``slip`` of the answers is given by accident, all of them equally often.

    Args:
        rationalities: that a person may have, equally likely before the first answer.
        chance: probability, before the first answer, that a person's answers are chance: that the
            rationality is 0. In ``[0, 1)``.
        slip: share of accidents, in ``[0, 1)``.
        half_life: number of answers after which an older one counts half: people change their minds,
            and their utility is not quite the model's, so that many answers must not make it certain.
            ``None`` for answers that count forever.
        tie: odds of "the same" against either of two equal alternatives; 0 if nobody may say so.
        neither: odds of "neither" against either of two average alternatives; 0 if nobody may.

    Raises:
        ValueError: for a number out of its range.

    Example:
        >>> import torch
        >>> model = ChoiceModel(slip=0.0, tie=1.0, neither=0.0)
        >>> model.probabilities(torch.tensor(1.0), torch.tensor(1.0), torch.tensor(2.0))
        tensor([0.3333, 0.3333, 0.3333, 0.0000])
    """

    rationalities: tuple[float, ...] = (1.0, 2.0, 4.0)
    chance: float = 0.1
    slip: float = 0.05
    half_life: float | None = 10.0
    tie: float = 0.5
    neither: float = 0.1

    def __post_init__(self) -> None:
        object.__setattr__(self, "rationalities", tuple(self.rationalities))
        if not self.rationalities:
            raise ValueError("rationalities must hold at least one number, got none.")
        for index, value in enumerate(self.rationalities):
            if not (is_number(value) and value > 0):
                raise ValueError(
                    f"rationalities[{index}] must be finite and above 0, got {value!r}."
                )
        for name in ("slip", "chance"):
            value = getattr(self, name)
            if not (is_number(value) and 0 <= value < 1):
                raise ValueError(f"{name} must be at least 0 and below 1, got {value!r}.")
        if self.half_life is not None and not (is_number(self.half_life) and self.half_life > 0):
            raise ValueError(
                f"half_life must be finite and above 0, or None, got {self.half_life!r}."
            )
        for name in ("tie", "neither"):
            value = getattr(self, name)
            if not (is_number(value) and value >= 0):
                raise ValueError(f"{name} must be finite and at least 0, got {value!r}.")

    @property
    def prior(self) -> dict[float, float]:
        """Probability of every rationality before the first answer, 0 among them.

        Example:
            >>> ChoiceModel(rationalities=(1.0, 2.0), chance=0.2).prior
            {0.0: 0.2, 1.0: 0.4, 2.0: 0.4}
        """
        share = (1 - self.chance) / len(self.rationalities)
        start = {0.0: self.chance} if self.chance else {}
        return start | dict.fromkeys(map(float, self.rationalities), share)

    @property
    def memory(self) -> float:
        """What is left of the weight of an answer when another one is given."""
        return 1.0 if self.half_life is None else 0.5 ** (1 / self.half_life)

    @property
    def offered(self) -> tuple[Answer, ...]:
        """The answers that can be given."""
        odds = (1.0, 1.0, self.tie, self.neither)
        return tuple(answer for answer, one in zip(ANSWERS, odds, strict=True) if one > 0)

    def probabilities(self, first: Tensor, second: Tensor, rationality: Tensor) -> Tensor:
        """Probabilities of :data:`ANSWERS`.

        Args:
            first: utilities of first alternatives, ``[*B]``.
            second: of the second ones, ``[*B]``.
            rationality: ``[*B]``; all three are broadcast.

        Returns:
            ``[*B, 4]``; they sum to one, and are 0 for what is not offered.
        """
        return self.by_answer(first, second, rationality).movedim(0, -1)

    def by_answer(self, first: Tensor, second: Tensor, rationality: Tensor) -> Tensor:
        """The same with the answers first, ``[4, *B]``."""
        first, second = torch.broadcast_tensors(rationality * first, rationality * second)
        odds = first.new_tensor([1.0, 1.0, self.tie, self.neither]).view(4, *[1] * first.ndim)
        logits = torch.stack((first, second, (first + second) / 2, torch.zeros_like(first)))
        # What is not offered has the logit -inf.
        shares = logits.add_(odds.log()).softmax(0)
        accident = (odds > 0).to(odds) * (self.slip / len(self.offered))
        return shares.mul_(1 - self.slip).add_(accident)

    def log_likelihood(
        self, choices: Sequence[Choice], weights: Tensor, rationality: Tensor
    ) -> Tensor:
        """Logarithms of the probabilities of some answers, where older ones count less.

        Args:
            choices: ``n`` of them, oldest first.
            weights: hypotheses, ``[H, T]``.
            rationality: ``[H]``.

        Returns:
            ``[n, H]``.
        """
        if not choices:
            return weights.new_zeros(0, len(weights))
        first, second = (
            weights.new_tensor([getattr(choice, side) for choice in choices]) @ weights.T
            for side in ("first", "second")
        )
        numbers = torch.arange(len(choices))
        said = torch.tensor([ANSWERS.index(choice.answer) for choice in choices])
        chances = self.by_answer(first, second, rationality)[said, numbers]
        share = self.memory ** numbers.flip(0).to(weights)
        return share[:, None] * chances.log()
