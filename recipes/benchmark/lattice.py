"""The evaluation of a training: returns over a lattice of preferences, indicators, and the front."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, ClassVar

import torch
import tqdm
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor
from torchrl.record.loggers import Logger

from recipes.training import logs
from recipes.training.policies import finish
from torchrl_morl.deploy import save_policy
from torchrl_morl.evaluation import rollout_preferences, steerability
from torchrl_morl.modules import fold_standardization
from torchrl_morl.preferences import PreferenceSpace

from .fronts import FILE, Front
from .pictures import draw_fronts
from .problem import BenchmarkProblem

CHOICE = "choice"
"""Where the actor of discrete actions writes how much it is for each of them."""


def lattice(preference_space: PreferenceSpace, most: int) -> Tensor:
    """The finest regular lattice of the simplex with at most so many points, at least its corners.

    Examples:
        >>> lattice(PreferenceSpace(("a", "b")), 3)
        tensor([[0.0000, 1.0000],
                [0.5000, 0.5000],
                [1.0000, 0.0000]])
        >>> three = PreferenceSpace(("a", "b", "c"))
        >>> len(lattice(three, 14)), len(lattice(three, 15))
        (10, 15)
    """
    bars = preference_space.num_tunable - 1
    divisions = 1
    while math.comb(divisions + 1 + bars, bars) <= most:
        divisions += 1
    return preference_space.lattice(divisions)


@dataclasses.dataclass(frozen=True)
class LatticeResult:
    """Deterministic episodes under every preference of the lattice."""

    front: Front
    indicators: dict[str, float]
    """See :meth:`.fronts.Front.indicators`."""
    key_solutions: Tensor
    """Mean scaled discounted return at each corner, ``[K, K]``; they are compared with values."""
    steps: float
    """Of an episode, on average."""

    @property
    def hypervolume(self) -> float:
        return self.indicators["hypervolume"]

    @property
    def score(self) -> float:
        """Mean utility of what the policy does under each preference; picks the best policy."""
        return self.indicators["commanded_utility"]

    @property
    def metrics(self) -> dict[str, float]:
        found = {f"eval/{name}": value for name, value in self.indicators.items()}
        return {**found, "eval/score": self.score, "eval/steps": self.steps}

    def table(self, frames: int) -> str:
        names, values = self.front.objectives, self.indicators
        width = max(12, *(len(name) + 2 for name in names))
        title = "".join(f"{name:>{width}}" for name in names)
        lines = [
            f"after {frames:,} steps, mean returns",
            f"{'preference':>{8 * len(names)}} |{title}",
        ]
        for preference, returned in zip(self.front.preferences, self.front.returns, strict=True):
            weights = "".join(f"{weight:8.2f}" for weight in preference)
            lines.append(f"{weights} |" + "".join(f"{value:{width}.2f}" for value in returned))
        lines.append(
            f"hypervolume {values['hypervolume']:.6g}, expected utility "
            f"{values['expected_utility']:.6g} (as commanded {values['commanded_utility']:.6g}), "
            f"{values['non_dominated']:.0f} points that none dominates, "
            f"sparsity {values['sparsity']:.4g} (misleading: one point has 0)"
        )
        return "\n".join(lines)


class LatticeEvaluation:
    """An :class:`~recipes.training.evaluation.Evaluation` over a lattice of preferences.

    Args:
        cfg: the configuration.
        problem: what it is about.
    """

    shown: ClassVar[dict[str, str]] = {"hypervolume": "{:.4g}", "score": "{:.4g}"}

    def __init__(self, cfg: DictConfig, problem: BenchmarkProblem) -> None:
        self.cfg, self.problem = cfg, problem
        self.preferences = lattice(problem.preference_space, cfg.evaluation.preferences)

    def __call__(self, actor: TensorDictModuleBase) -> LatticeResult:
        cfg, problem = self.cfg, self.problem
        with tqdm.tqdm(
            total=len(self.preferences), desc="evaluation", unit="preference", leave=False
        ) as progress:
            data = rollout_preferences(
                problem.eval_env,
                deterministic(problem, actor),
                self.preferences,
                max_steps=problem.max_episode_steps,
                seed=cfg.evaluation.seed,
                keep=_rewards,
                on_preference=lambda _: progress.update(),
            )
        reward, mask = data["next", "reward"].double(), data["mask"]
        reward = reward * mask.unsqueeze(-1)
        discount = cfg.loss.gamma ** torch.arange(reward.shape[-2], dtype=torch.float64)
        discounted = (discount.unsqueeze(-1) * reward).sum(-2).mean(1)  # [P, K]
        front = Front(
            objectives=problem.preference_space.objectives,
            preferences=self.preferences.double().numpy(),
            returns=reward.sum(-2).mean(1).numpy(),
            discounted=discounted.numpy(),
        )
        corners = problem.preference_space.corners()
        places = (self.preferences.unsqueeze(0) == corners.unsqueeze(1)).all(-1).int().argmax(-1)
        return LatticeResult(
            front=front,
            indicators=front.indicators(problem.reference, discounted=cfg.evaluation.discounted),
            key_solutions=(cfg.replay_buffer.reward_scale * discounted[places]).float(),
            steps=mask.sum(-1).double().mean().item(),
        )

    def save(
        self,
        actor: TensorDictModuleBase,
        result: LatticeResult,
        frames: int,
        loggers: list[Logger],
        **facts: Any,
    ) -> None:
        cfg, problem = self.cfg, self.problem
        logs.log_metrics(loggers, result.metrics, frames)
        folder = problem.run_dir / "policies" / f"{frames:09d}"
        # One that is there stays: a training that was killed before its checkpoint makes the same once more.
        if not folder.exists():
            save_policy(
                folder,
                fold_standardization(actor),
                preference_space=problem.preference_space,
                period=problem.env.base_env.period,
                robot=cfg.env,
                card={
                    **problem.facts,
                    **facts,
                    "config": OmegaConf.to_container(cfg, resolve=True),
                    "reference": problem.reference,
                    "metrics": result.metrics,
                    "score": result.score,
                },
            )
        result.front.write(problem.run_dir / "fronts" / f"{frames:09d}.csv")
        result.front.write(problem.run_dir / FILE)
        draw_fronts(
            {f"after {frames:,} steps": result.front},
            problem.run_dir / "pictures" / f"{frames:09d}.png",
            title=f"{cfg.env}, {cfg.algorithm}",
        )

    def end(self, result: LatticeResult) -> None:
        for line in what_does_not_steer(result.front, self.cfg.loss.gamma):
            print(f"warning: {line}")
        if not result.hypervolume > 0:
            print(
                f"warning: no point exceeds evaluation.reference={list(self.problem.reference)} in all "
                "objectives: the hypervolume is 0. Give a lower one."
            )
        finish(self.problem.run_dir, self.cfg)


def what_does_not_steer(front: Front, gamma: float) -> list[str]:
    """A line for each objective whose return does not follow its weight.

    A policy is trained for discounted returns. Where these follow and the sums do not, the episodes tell
    why: one that is asked for speed falls early, and an episode that ends early has a small sum.

    Args:
        front: of the policy.
        gamma: that it was trained with.

    Examples:
        >>> import numpy as np
        >>> weights, falls = np.eye(2), np.array([[1.0, 0.0], [2.0, 3.0]])
        >>> what_does_not_steer(Front(("fast", "high"), weights, falls, np.eye(2)), 0.99)
        ['the sums of fast do not follow its weight (rank correlation -1.00), its discounted returns \
do (1.00): a greater loss.gamma than 0.99 looks further ahead.']
    """
    lines = []
    for index, name in enumerate(front.objectives):
        weight = front.preferences[:, index]
        discounted = steerability(weight, front.discounted[:, index])
        sums = steerability(weight, front.returns[:, index])
        if not discounted >= 0.5:
            lines.append(
                f"the preference hardly steers {name} (rank correlation of weight and discounted "
                f"return {discounted:.2f}): train longer, or scale its reward."
            )
        elif not sums >= 0.5:
            lines.append(
                f"the sums of {name} do not follow its weight (rank correlation {sums:.2f}), its "
                f"discounted returns do ({discounted:.2f}): a greater loss.gamma than {gamma:g} looks "
                "further ahead."
            )
    return lines


def deterministic(problem: BenchmarkProblem, actor: TensorDictModuleBase) -> TensorDictModuleBase:
    """The policy that an actor is without exploration."""
    if problem.num_actions is None:
        return actor
    best = TensorDictModule(_best, in_keys=[CHOICE], out_keys=["action"])
    return TensorDictSequential(actor, best)


def _best(choice: Tensor) -> Tensor:
    return choice.argmax(-1)


def _rewards(data: TensorDictBase) -> TensorDictBase:
    return data.select(("next", "reward"))
