"""Questions and answers with one person, kept in a folder."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path

import torch
from torch import Tensor

from torchrl_morl.choices import (
    Answer,
    PreferencePosterior,
    Question,
    Recommendation,
    best_preference,
    next_question,
)

from ..evaluation.sweep import Sweep
from .picture import chosen_picture, question_picture
from .rollouts import arrived, joint_outcomes

POSTERIOR = "answers.json"
PREFERENCE = "preference.json"

KEYS: dict[str, Answer] = {"1": "first", "2": "second", "=": "tie", "n": "neither"}
"""What is typed for which answer."""


@dataclasses.dataclass
class Dialogue:
    """One person, one policy, and its drives in one scene or more, each a context.

    Args:
        folder: where answers and pictures lie.
        drives: of the policy, by context.
        goal_radius: by context, metres.
        posterior: what is known.
        seed: of the questions.
    """

    folder: Path
    drives: dict[str, Sweep]
    goal_radius: dict[str, float]
    posterior: PreferencePosterior
    seed: int = 0

    def __post_init__(self) -> None:
        self.outcomes: dict[str, Tensor] = joint_outcomes(self.drives)
        # Copies: what is skipped has arrived nevertheless.
        self._valid = {name: arrived(one).clone() for name, one in self.drives.items()}
        self._skipped = 0

    def ask(self) -> tuple[str, Question]:
        """The most valuable question of all contexts, the same for the same answers."""
        questions, count = [], self.posterior.num_answers
        for place, context in enumerate(self.posterior.contexts):
            # A resumed dialogue goes on as if it had not been interrupted.
            number = ((self.seed * 1000 + count) * 1000 + self._skipped) * 10 + place
            question = next_question(
                self.posterior,
                self.outcomes[context],
                context=context,
                valid=self._valid[context],
                generator=torch.Generator().manual_seed(number),
            )
            questions.append((context, question))
        return max(questions, key=lambda one: one[1].worth)

    def skip(self, context: str, question: Question) -> None:
        """Show the first drive of a question no more, and ask something else."""
        self._valid[context][question.scene, question.first] = False
        self._skipped += 1

    def draw(self, context: str, question: Question) -> Path:
        """Draw a question."""
        number = self.posterior.num_answers + 1
        where = f" ({context})" if len(self.drives) > 1 else ""
        return question_picture(
            self.folder / f"question_{number:02d}.png",
            self.drives[context],
            question.scene,
            (question.first, question.second),
            goal_radius=self.goal_radius[context],
            title=f"Question {number}{where}: which drive do you like better?",
        )

    def take(self, context: str, question: Question, answer: Answer) -> None:
        """Take an answer in and save it."""
        outcomes = self.outcomes[context][question.scene]
        self.posterior.answer(outcomes[question.first], outcomes[question.second], answer, context)
        self._skipped = 0
        self.posterior.save(self.folder / POSTERIOR)

    def undo(self) -> bool:
        """Forget the newest answer; false if there is none."""
        if not self.posterior.num_answers:
            return False
        self.posterior.undo()
        self._skipped = 0
        self.posterior.save(self.folder / POSTERIOR)
        return True

    def best(self) -> dict[str, Recommendation]:
        """What the policy should be given, by context."""
        return {
            context: best_preference(
                self.posterior, self.outcomes[context], result.preferences, context=context
            )
            for context, result in self.drives.items()
        }

    def lines(self) -> Iterator[str]:
        """The preference in words, and how sure it is."""
        for context, best in self.best().items():
            names = self.drives[context].preference_space.tunable
            weights = ", ".join(
                f"{name} {value:.1f}"
                for name, value in zip(names, best.preference.tolist(), strict=True)
            )
            where = f"{context}: " if len(self.drives) > 1 else ""
            yield f"  {where}your preference so far: {weights}"
            yield (
                f"  it is about {100 * (1 - best.regret):.0f} % of the best there is for you, likely "
                f"above {100 * (1 - best.regret_high):.0f} %"
            )
        chance = max(self.posterior.chance(context) for context in self.drives)
        if self.posterior.num_answers >= 5 and chance > 0.5:
            yield (
                f"  these answers may follow no preference (probability {100 * chance:.0f} %): u takes "
                "the last one back"
            )

    def finish(self) -> list[Path]:
        """Write the preference and what it does."""
        written, entries = [self.folder / PREFERENCE], {}
        for context, best in self.best().items():
            result = self.drives[context]
            names = result.preference_space.tunable
            entries[context] = {
                "preference": dict(zip(names, best.preference.tolist(), strict=True)),
                "expected_regret": best.regret,
                "regret_90_percent": best.regret_high,
                "answers_follow_no_preference": best.chance,
            }
            name = "chosen.png" if len(self.drives) == 1 else f"chosen_{context}.png"
            weights = ", ".join(f"{n} {v:.1f}" for n, v in entries[context]["preference"].items())
            written.append(
                chosen_picture(
                    self.folder / name,
                    result,
                    best.index,
                    goal_radius=self.goal_radius[context],
                    title=f"Chosen by {self.posterior.num_answers} answers: {weights}",
                )
            )
        state = {"answers": self.posterior.num_answers, "contexts": entries}
        written[0].write_text(json.dumps(state, indent=1) + "\n")
        return written
