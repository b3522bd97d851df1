"""A preference from choices: which of two alternatives a person likes better, asked a few times.

Outcomes in, a preference out: pure functions of what alternatives did, for any policy and any
environment. Start at :class:`PreferencePosterior`.
"""

from .model import ANSWERS, Answer, Choice, ChoiceModel
from .outcomes import standardize
from .posterior import PreferencePosterior
from .question import Question, information, next_question, value_of_information
from .recommendation import Recommendation, best_preference

__all__ = [
    "ANSWERS",
    "Answer",
    "Choice",
    "ChoiceModel",
    "PreferencePosterior",
    "Question",
    "Recommendation",
    "best_preference",
    "information",
    "next_question",
    "standardize",
    "value_of_information",
]
