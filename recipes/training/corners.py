"""Evaluation during training: the corner preferences and their mean, in fixed scenes."""

from __future__ import annotations

import dataclasses

import torch
from omegaconf import DictConfig
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor

from envs.metrics import episode_metrics, trajectories
from torchrl_morl.evaluation import discrete_frechet, min_clearance, rollout_preferences

from .task import Task


@dataclasses.dataclass(frozen=True)
class CornerResult:
    """Deterministic episodes at the corner preferences and at their mean."""

    names: tuple[str, ...]
    columns: dict[str, list[float]]
    """One value per preference."""
    key_solutions: Tensor
    """Mean scaled return of the tunable objectives at each corner, ``[T, T]``."""
    score: float
    """Mean scaled utility over the preferences; picks the best checkpoint."""
    paths: TensorDict
    """``[P, N]``, see :func:`envs.metrics.trajectories`."""

    @property
    def success(self) -> float:
        """Over all preferences, percent."""
        return sum(self.columns["success"]) / len(self.names)

    @property
    def metrics(self) -> dict[str, float]:
        """Flat names for the loggers."""
        flat = {"eval/score": self.score, "eval/success": self.success}
        for column, values in self.columns.items():
            for name, value in zip(self.names, values, strict=True):
                flat[f"eval/{column}/{name}"] = value
        return flat

    def table(self, frames: int) -> str:
        """For the terminal."""
        lines = [f"after {frames:,} steps (score {self.score:.2f})"]
        lines.append(f"{'preference':>12}" + "".join(f"{name:>12}" for name in self.columns))
        for row, name in enumerate(self.names):
            values = "".join(f"{column[row]:12.2f}" for column in self.columns.values())
            lines.append(f"{name:>12}{values}")
        return "\n".join(lines)


def evaluate_corners(cfg: DictConfig, task: Task, actor: TensorDictModule) -> CornerResult:
    """Drive under the corner preferences, and under their mean, in the scenes of the evaluation."""
    preference_space, demonstration = task.preference_space, task.demonstration
    corners = preference_space.corners()
    preferences = torch.cat((corners, corners.mean(0, keepdim=True)))
    data = rollout_preferences(
        task.eval_env,
        actor,
        preferences,
        max_steps=cfg.env.max_episode_steps,
        seed=cfg.evaluation.seed,
    )
    mask, metrics = data["mask"], episode_metrics(data)
    reward = cfg.replay_buffer.reward_scale * data["next", "reward"]
    returns = (reward * mask.unsqueeze(-1)).sum(-2)  # [P, N, K]
    utility = (preference_space.weights(preferences).unsqueeze(1) * returns).sum(-1)
    collision = metrics["collision_human"] | metrics["collision_obstacle"]
    saturated = (data["action"].abs() > 0.99).float().mean(-1)
    columns = {
        "success": 100 * metrics["success"].float().mean(-1),
        "collision": 100 * collision.float().mean(-1),
        "timeout": 100 * metrics["timeout"].float().mean(-1),
        "time": metrics["time"].nanmean(-1),
        "human": metrics["min_human_distance"].nanmean(-1),
        "saturated": (saturated * mask).sum((-2, -1)) / mask.sum((-2, -1)),
    }
    path = trajectories(data)
    if "clearance" in preference_space.tunable:
        columns["clearance"] = min_clearance(
            path["position"],
            task.scenes["boxes"],
            path["mask"],
            task.scenes.get("robot", None)[..., 0]
            if "robot" in task.scenes.keys()
            else task.eval_env.base_env.robot.radius,
        ).mean(-1)
    if demonstration is not None:
        frechet = discrete_frechet(
            path["position"], path["mask"], demonstration["position"], demonstration["mask"]
        )
        columns["frechet"] = frechet[:, demonstration["free"]].mean(-1)
        columns["frechet all"] = frechet.mean(-1)
    return CornerResult(
        names=(*preference_space.tunable, "balanced"),
        columns={name: values.tolist() for name, values in columns.items()},
        key_solutions=returns[: len(corners)].mean(1)[:, list(preference_space.tunable_indices)],
        score=utility.mean().item(),
        paths=path,
    )
