"""What a training tells while it runs: scalars for the loggers, a line for the progress bar."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

import tqdm
from omegaconf import DictConfig, OmegaConf
from tensorboard.compat.proto.event_pb2 import Event, SessionLog
from torch import Tensor
from torchrl._utils import timeit
from torchrl.record.loggers import (
    Logger,
    MLFlowLogger,
    TensorboardLogger,
    WandbLogger,
    get_logger,
)
from torchrl.record.loggers.trackio import TrackioLogger

from torchrl_morl.preferences import PreferenceSpace

from .checkpoint import Counters


def make_loggers(cfg: DictConfig, run_dir: Path, *, begin: int = 0) -> list[Logger]:
    """The loggers of the configuration; what they hold of later than ``begin`` steps comes again."""
    forget_later_rows(run_dir / "log_csv", begin)
    arguments = OmegaConf.to_container(cfg.logger, resolve=True).get("arguments") or {}
    loggers = [
        make_logger(backend, run_dir, arguments.get(backend, {})) for backend in cfg.logger.backends
    ]
    for logger in loggers:
        if isinstance(logger, TensorboardLogger) and begin:
            # As SummaryWriter(purge_step=...): readers drop what stands from that step on.
            restart = SessionLog(status=SessionLog.START)
            writer = logger.experiment._get_file_writer()
            writer.add_event(Event(step=begin + 1, session_log=restart))
    return loggers


def make_logger(backend: str, run_dir: Path, arguments: dict[str, Any]) -> Logger:
    """A logger of TorchRL.

    Args:
        backend: its name.
        run_dir: of the training, to which files go; other backends call the run after it.
        arguments: of the logger, and behind it of ``wandb.init`` or ``trackio.init``.

    Raises:
        ValueError: if the logger takes no such arguments, or cannot begin.
    """
    if backend in ("csv", "tensorboard"):
        return get_logger(backend, logger_name=str(run_dir), experiment_name=f"log_{backend}")
    kind, defaults = {
        "wandb": (WandbLogger, {"save_dir": str(run_dir)}),
        "trackio": (TrackioLogger, {"project": "torchrl_morl"}),
        "mlflow": (MLFlowLogger, {"tracking_uri": f"sqlite:///{run_dir.resolve()}/mlflow.db"}),
    }[backend]
    try:
        logger = kind(**{"exp_name": run_dir.name, **defaults, **arguments})
        _ = logger.experiment  # which some begin when they are first asked for it
    except Exception as error:  # of packages that have their own
        what = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(f"logger.backends: {backend} with {arguments}: {what}") from error
    return logger


def forget_later_rows(folder: Path, last: int) -> None:
    """Drop the rows of a CSV logger that are of later steps than the last one that counts.

    Raises:
        ValueError: for a file that it has not written.
    """
    for file in folder.glob("scalars/**/*.csv"):
        try:
            rows = file.read_text().splitlines(keepends=True)
            # A killed process may have written half a row.
            kept = [row for row in rows if row.endswith("\n") and float(row.split(",")[0]) <= last]
        except ValueError as error:
            raise ValueError(f"{file} was not written by a run: {error}") from error
        if len(kept) < len(rows):
            partial = file.with_name(f".{file.name}")
            partial.write_text("".join(kept))
            partial.replace(file)


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


def progress_line(progress: tqdm.tqdm, count: Counters, shown: dict[str, str]) -> dict[str, str]:
    """Beside steps/s and the time left, which the bar itself shows; ``shown`` are names and formats."""
    bar = progress.format_dict
    # A resumed training has made some of its updates in another process.
    share = (bar["n"] - bar["initial"]) / max(bar["n"], 1)
    return {
        "updates/s": f"{share * count.updates / max(bar['elapsed'], 1e-9):.1f}",
        **{name: form.format(getattr(count, name)) for name, form in shown.items()},
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
