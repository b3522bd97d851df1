"""CORE: the core reward alone, a policy that no preference changes."""

from __future__ import annotations

import dataclasses

import torch
from tensordict.nn import TensorDictSequential
from torch import Tensor

from recipes.training.task import Task
from torchrl_morl.preferences import PreferenceSpace


class CoreSpace(PreferenceSpace):
    """Preferences that weigh nothing: only objectives with a static weight count."""

    def weights(self, preference: Tensor) -> Tensor:
        return super().weights(torch.zeros_like(preference))


def core_only(task: Task) -> Task:
    """The same task with rewards, and scores of the evaluation, that no preference changes."""
    preference_space = CoreSpace(task.preference_space.objectives, task.preference_space.static)
    return dataclasses.replace(
        task, preference_space=preference_space, facts={**task.facts, "preference": "ignored"}
    )


def cut_off_preference(actor: TensorDictSequential, preference_space: PreferenceSpace) -> None:
    """Zero what the actor's first layer makes of the preference.

    Trained with zero preferences these weights get no gradient and stay zero: the policy keeps the
    inputs that all policies have, and ignores the last of them.
    """
    first = actor[0].module[0]
    with torch.no_grad():
        first.weight[:, -preference_space.num_tunable :] = 0.0
