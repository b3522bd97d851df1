"""What a training tells while it runs: scalars for the loggers, a line for the progress bar."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import tqdm
from omegaconf import DictConfig
from torch import Tensor
from torchrl.record.loggers import Logger, get_logger

from torchrl_morl.preferences import PreferenceSpace


def make_loggers(cfg: DictConfig, run_dir: Path) -> list[Logger]:
    return [
        get_logger(backend, logger_name=str(run_dir), experiment_name=f"log_{backend}")
        for backend in cfg.logger.backends
    ]


def log_metrics(loggers: list[Logger], metrics: dict[str, Any], frames: int) -> None:
    for logger in loggers:
        for name, value in metrics.items():
            logger.log_scalar(name, float(value), step=frames)


def log_training(
    loggers: list[Logger],
    metrics: dict[str, Tensor],
    preference_space: PreferenceSpace,
    frames: int,
    updates: int,
) -> None:
    flat = {"train/updates": updates}
    for name, value in metrics.items():
        if name == "q_scale":
            for objective, scale in zip(preference_space.objectives, value, strict=True):
                flat[f"train/q_scale/{objective}"] = scale
        else:
            flat[f"train/{name}"] = value.float().mean()
    log_metrics(loggers, flat, frames)


def progress_line(
    progress: tqdm.tqdm, updates: int, success: float, score: float
) -> dict[str, str]:
    """Beside steps/s and the time left, which the bar itself shows."""
    elapsed = progress.format_dict["elapsed"]
    return {
        "updates/s": f"{updates / max(elapsed, 1e-9):.1f}",
        "success": f"{success:.0f}%",
        "score": f"{score:.2f}",
    }


def crossed(interval: int, before: int, after: int) -> bool:
    """Whether a multiple of the interval lies in (before, after]."""
    return after // interval > before // interval
