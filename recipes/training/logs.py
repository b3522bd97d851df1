"""What a training tells while it runs: scalars for the loggers, a line for the progress bar."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

import tqdm
from omegaconf import DictConfig
from torch import Tensor
from torchrl._utils import timeit
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


def announce(cfg: DictConfig, run_dir: Path) -> None:
    """Where to watch a training, and what happens before it moves."""
    print(f"run folder: {run_dir} (a picture at every evaluation: {run_dir / 'pictures'})")
    if "tensorboard" in cfg.logger.backends:
        print(f"watch it: tensorboard --logdir {shlex.quote(str(run_dir))}")
    if cfg.compute.get("compile"):
        print("the first updates compile their graphs, about a minute, in which the bar stands")


def time_shares() -> str:
    """What the parts of a training took, of those that :class:`torchrl._utils.timeit` has seen."""
    seconds = timeit.todict(percall=False)
    total = sum(seconds.values())
    parts = sorted(seconds.items(), key=lambda part: -part[1])
    return "time: " + ", ".join(f"{name} {value / total:.0%}" for name, value in parts)


def warn_if_failing(success: float) -> None:
    """Say so where a training has failed at its purpose."""
    if success < 80:
        print(
            f"warning: the last policy reaches its goal in {success:.0f} % of the episodes: train "
            "longer, or look at the pictures for what goes wrong."
        )
