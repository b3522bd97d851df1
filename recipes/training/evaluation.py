"""What the loops of training ask of a problem and of its evaluations; navigation is one of them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_morl.preferences import PreferenceSpace


class Problem(Protocol):
    """What an agent is trained on; :class:`recipes.training.task.Task` is the navigation task."""

    @property
    def run_dir(self) -> Path: ...

    @property
    def device(self) -> torch.device: ...

    @property
    def preference_space(self) -> PreferenceSpace: ...

    @property
    def env(self) -> EnvBase:
        """Where it trains: ``observation``, ``preference``, and an ``action`` in [-1, 1]."""
        ...

    @property
    def make_env(self) -> Callable[[int, int], EnvBase]:
        """Another one to train in, of a seed and a number of environments; it can be pickled."""
        ...

    @property
    def statistics(self) -> tuple[Tensor, Tensor] | None:
        """Means and deviations ``[F]`` in whose units networks see observations; ``None``: as they are."""
        ...

    @property
    def facts(self) -> dict[str, Any]:
        """For the cards of its policies."""
        ...


class Result(Protocol):
    """What a policy did when it was evaluated."""

    @property
    def key_solutions(self) -> Tensor:
        """Mean scaled return of the tunable objectives at each corner preference, ``[T, T]``."""
        ...

    @property
    def metrics(self) -> dict[str, float]:
        """Flat names for the loggers."""
        ...

    def table(self, frames: int) -> str:
        """For the terminal."""
        ...


class Evaluation(Protocol):
    """How a training judges its policy, and what it leaves of it.

    Attributes:
        shown: attributes of a result that stand beside the progress bar, and their formats.
    """

    shown: dict[str, str]

    def __call__(self, actor: TensorDictModuleBase) -> Result:
        """Evaluate a policy."""
        ...

    def save(
        self, actor: TensorDictModuleBase, result: Any, frames: int, loggers: list, **facts: Any
    ) -> None:
        """Log the result, then save the policy and a picture of what it did; ``facts`` go to its card."""
        ...

    def end(self, result: Any) -> None:
        """Behind the last evaluation: say where the policies are, and where the training failed."""
        ...


def observation_size(problem: Problem) -> int:
    """Entries of the observation that the policy of a problem reads."""
    return problem.env.observation_spec["observation"].shape[-1]
