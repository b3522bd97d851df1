"""The evaluations of a navigation policy: corner preferences, a policy folder, a picture of the paths."""

from __future__ import annotations

from typing import Any, ClassVar

from omegaconf import DictConfig
from tensordict.nn import TensorDictModuleBase
from torchrl.record.loggers import Logger

from . import logs
from .corners import CornerResult, evaluate_corners
from .pictures import trajectories_picture
from .policies import finish, save_training_policy
from .task import Task


class CornerEvaluation:
    """An :class:`~recipes.training.evaluation.Evaluation` in the scenes of a task.

    Args:
        cfg: the configuration.
        task: what :func:`~recipes.training.task.make_task` made of it.
    """

    shown: ClassVar[dict[str, str]] = {"success": "{:.0f}%", "score": "{:.2f}"}

    def __init__(self, cfg: DictConfig, task: Task) -> None:
        self.cfg, self.task = cfg, task

    def __call__(self, actor: TensorDictModuleBase) -> CornerResult:
        return evaluate_corners(self.cfg, self.task, actor)

    def save(
        self,
        actor: TensorDictModuleBase,
        result: CornerResult,
        frames: int,
        loggers: list[Logger],
        **facts: Any,
    ) -> None:
        cfg, task = self.cfg, self.task
        logs.log_metrics(loggers, result.metrics, frames)
        # The small policy first: it is what a full disk must not cost.
        folder = task.run_dir / "policies" / f"{frames:09d}"
        save_training_policy(folder, cfg, actor, task, result, **facts)
        trajectories_picture(
            task.run_dir / "pictures" / f"{frames:09d}.png",
            task,
            result,
            frames=frames,
            goal_radius=cfg.env.goal_radius,
        )

    def end(self, result: CornerResult) -> None:
        logs.warn_if_failing(result.success)
        finish(self.task.run_dir, self.cfg)
