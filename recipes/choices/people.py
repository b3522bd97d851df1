"""Simulated people, who differ from the model of their choices in one way each, or in all of them.

============  ========================================================================================
kind          differs from the model in
============  ========================================================================================
irregularity  also cares about irregular paths, as much as about anything else
near          counts the seconds within 1.2 m of the human, not the smallest distance
threshold     keeps a distance of their own, 0.6 to 1.6 m, and has a patience of 1.0 to 1.3 x the
              straight drive; beyond either nothing matters. Unlike is unlike from 1 m of Frechet distance
noise         answers at half of the others' rationality, with twice as many accidents
mind          changes their mind, half of it, at one of twenty answers
everything    all of these at once, the last for one in five
============  ========================================================================================

All weigh up to four penalties, uniformly on the simplex, in units of the penalty's deviation in a scene.
All answer with noise, have accidents, call alike what differs little, and may dislike both of two bad
drives.
"""

from __future__ import annotations

import dataclasses
from typing import Literal, get_args

import torch
from torch import Tensor

from envs import NavigationEnv
from torchrl_morl.choices import Answer
from torchrl_morl.evaluation import path_irregularity

from ..evaluation.sweep import Sweep
from ..objectives import DEMO, PERSONAL_SPACE
from .rollouts import MAX_STEPS, UNLIKE

Kind = Literal["irregularity", "near", "threshold", "noise", "mind", "everything"]

KINDS: tuple[Kind, ...] = get_args(Kind)
"""The last one is counted apart."""

OBJECTIVES = (DEMO, "distance", "efficiency")
"""Of the policy whose drives they see."""

_OBJECTIVE_OF = (0, 1, 2, 2)
"""Which of these people would name for their penalties, if they were asked for weights."""

NEAR = 1.2
"""Metres."""


@dataclasses.dataclass(frozen=True)
class Drives:
    """What people notice of drives, each ``[S, P]``: scenes, preferences."""

    frechet: Tensor
    distance: Tensor
    near: Tensor
    time: Tensor
    straight_time: Tensor
    irregularity: Tensor
    arrived: Tensor

    @classmethod
    def of(cls, result: Sweep, *, max_speed: float, goal_radius: float) -> Drives:
        """Of a sweep; speed in m/s, radius in metres."""
        paths, period = result.paths, NavigationEnv.CONTROL_PERIOD
        position, mask = paths["position"], paths["mask"]
        goal = result.scenes["goal"].expand(*mask.shape[:2], 2)
        apart = (position - paths["human"]).norm(dim=-1)
        values = {
            "frechet": result.metrics["frechet"],
            "distance": result.metrics["min_human_distance"],
            "near": ((apart < NEAR) & mask).sum(-1) * period,
            "time": result.metrics["time"].nan_to_num(MAX_STEPS * period),
            "straight_time": (result.metrics["direct_distance"] - goal_radius) / max_speed,
            "irregularity": path_irregularity(position, paths["heading"], mask, goal),
        }
        columns = {name: value.double().T.contiguous() for name, value in values.items()}
        return cls(**columns, arrived=result.metrics["success"].T)


@dataclasses.dataclass(frozen=True)
class Person:
    """One who answers.

    Args:
        kind: see above.
        weights: of the penalties, ``[4]``: strange, close, late, irregular.
        later: the same after a change of mind.
        change: the number of answers after which the mind is changed; ``None`` for never.
        threshold: distance that is respected, metres.
        patience: times the straight drive.
        rationality: of answers, where utilities of a scene have a standard deviation of one.
        slip: share of accidents.
        same: difference below which two drives are alike, in the same unit.
    """

    kind: Kind
    weights: Tensor
    later: Tensor
    change: int | None = None
    threshold: float = 1.1
    patience: float = 1.15
    rationality: float = 3.0
    slip: float = 0.05
    same: float = 0.15

    def penalties(self, drives: Drives) -> Tensor:
        """Strange, close, late and irregular, ``[S, P, 4]``, in their own units."""
        unlike = 1.0 if self.kind in ("threshold", "everything") else UNLIKE
        close = -drives.distance.clamp(max=PERSONAL_SPACE)
        late = drives.time
        if self.kind in ("threshold", "everything"):
            close = (self.threshold - drives.distance).clamp(min=0)
            late = (drives.time - self.patience * drives.straight_time).clamp(min=0)
        if self.kind == "near":
            close = drives.near
        if self.kind == "everything":
            close = close / 0.14 + drives.near / 1.8  # of about equal deviation
        strange = drives.frechet.clamp(max=unlike)
        values = torch.stack((strange, close, late, drives.irregularity), -1)
        # A drive that does not arrive is as bad as the worst that does, in everything.
        arrived = drives.arrived.unsqueeze(-1)
        worst = values.where(arrived, -torch.inf).amax(1, keepdim=True)
        return values.where(arrived, worst)

    def utility(self, drives: Drives, units: Tensor, answers: int = 0) -> Tensor:
        """Utility of every drive, ``[S, P]``, after so many answers; ``units`` of :func:`units_of`."""
        weights = self.later if self.changed(answers) else self.weights
        return -(self.penalties(drives) / units) @ weights

    def changed(self, answers: int) -> bool:
        """Whether the mind is another one after so many answers."""
        return self.change is not None and answers >= self.change

    def answer(
        self, utility: Tensor, first: int, second: int, generator: torch.Generator
    ) -> Answer:
        """What is said of two drives of a scene.

        Args:
            utility: of all drives of the scene, ``[P]``, in units of their deviation.
            first: one of them.
            second: the other one.
            generator: the source of randomness.
        """
        slip, draw, both = torch.rand(3, generator=generator).tolist()
        if slip < self.slip:
            return ("first", "second", "tie", "neither")[int(4 * draw)]
        bad = utility.quantile(0.15)
        if max(utility[first], utility[second]) <= bad and both < 0.5:
            return "neither"
        difference = float(utility[first] - utility[second])
        if abs(difference) < self.same:
            return "tie"
        likes = torch.tensor(self.rationality * difference).sigmoid()
        return "first" if draw < likes else "second"

    def stated(self, generator: torch.Generator, *, error: float) -> Tensor:
        """Weights of :data:`OBJECTIVES` that they would say, ``[3]``, in tenths.

        Args:
            generator: the source of randomness.

        Keyword Args:
            error: standard deviation of the logarithm of what is said.
        """
        total = self.weights.new_zeros(3).index_add_(0, torch.tensor(_OBJECTIVE_OF), self.weights)
        noise = torch.randn(3, generator=generator, dtype=torch.float64)
        said = total * (error * noise).exp()
        rounded = (10 * said / said.sum()).round()
        return rounded / rounded.sum()


def people(kind: Kind, count: int, generator: torch.Generator) -> list[Person]:
    """Simulated people of one kind."""

    def uniform(low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand((), generator=generator))

    def simplex() -> Tensor:
        raw = torch.empty(4, dtype=torch.float64).exponential_(generator=generator)
        if kind not in ("irregularity", "everything"):
            raw[3] = 0
        return raw / raw.sum()

    found = []
    for _ in range(count):
        noisy = kind in ("noise", "everything")
        weights, other = simplex(), simplex()
        change = int(torch.randint(1, 21, (), generator=generator))
        changes = kind == "mind" or (kind == "everything" and uniform(0, 1) < 0.2)
        found.append(
            Person(
                kind=kind,
                weights=weights,
                later=(weights + other) / 2,
                change=change if changes else None,
                threshold=uniform(0.6, 1.6),
                patience=uniform(1.0, 1.3),
                rationality=3 * 2 ** uniform(-1, 1) / (2 if noisy else 1),
                slip=uniform(0.0, 0.2 if noisy else 0.1),
                same=uniform(0.0, 0.3),
            )
        )
    return found


def units_of(kind: Kind, drives: Drives) -> Tensor:
    """Deviation of each penalty of somebody average in a scene, ``[4]``: the unit that it is weighed in."""
    average = Person(kind, torch.ones(4), torch.ones(4))
    return average.penalties(drives).std(1).square().mean(0).sqrt()


def in_units(utility: Tensor) -> Tensor:
    """Utilities ``[S, P]`` as a person feels them: with a deviation of one in a scene."""
    apart = utility - utility.mean(1, keepdim=True)
    return apart / utility.std(1).square().mean().sqrt()
