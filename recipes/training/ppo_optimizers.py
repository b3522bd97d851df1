"""Optimizers of MO-PPO, and the schedules of the learning rate, of the noise and of lambda."""

from __future__ import annotations

import torch
from omegaconf import DictConfig, OmegaConf
from torchrl.objectives import ClipPPOLoss


def make_optimizers(cfg: DictConfig, loss: ClipPPOLoss) -> dict[str, torch.optim.Optimizer]:
    """Adam for each network."""
    return {
        "actor": torch.optim.Adam(
            loss.actor_network_params.flatten_keys().values(), lr=cfg.optim.lr, fused=True
        ),
        "critic": torch.optim.Adam(
            loss.critic_network_params.flatten_keys().values(), lr=cfg.optim.critic_lr, fused=True
        ),
    }


def make_schedule(
    cfg: DictConfig, optimizer: torch.optim.Optimizer, frames: int, begin: int
) -> torch.optim.lr_scheduler.LambdaLR:
    """Lets the actor's rate fall linearly to a twentieth until the end of the training.

    Args:
        cfg: the configuration; the rate is that of ``optim.lr``, also where the optimizer was loaded.
        optimizer: of the actor.
        frames: how many have been collected already.
        begin: after how many frames it begins to fall: 0, or, of a run that goes on from one that was
            over, those of that one. The rate then falls anew, a warm restart
            (https://arxiv.org/abs/1608.03983).
    """
    size = cfg.collector.frames_per_batch
    batches = -(-(cfg.collector.total_frames - begin) // size)
    waits = cfg.optim.critic_batches if begin == 0 else 0
    done, updates = max(0, (frames - begin) // size - waits), max(1, batches - waits)
    for group in optimizer.param_groups:
        group["lr"] = group["initial_lr"] = cfg.optim.lr
    return torch.optim.lr_scheduler.LambdaLR(
        optimizer, lambda step: 1 - 0.95 * min(1.0, step / updates), last_epoch=done - 1
    )


def noise(cfg: DictConfig, frames: int) -> torch.Tensor:
    """Standard deviations after so many frames: they fall geometrically to the final ones.

    Returns:
        One for each entry of the action, or a single one, as the configuration has them.
    """
    first, last = (
        torch.as_tensor(OmegaConf.to_container(cfg.collector)[name], dtype=torch.float32)
        for name in ("exploration_sigma", "final_exploration_sigma")
    )
    return first * (last / first) ** _share(cfg, frames)


def scheduled(cfg: DictConfig, name: str, frames: int) -> float:
    """``loss.NAME`` after so many frames: it goes linearly to ``loss.final_NAME``, where there is one."""
    first, last = cfg.loss[name], cfg.loss.get(f"final_{name}")
    return first if last is None else first + (last - first) * _share(cfg, frames)


def _share(cfg: DictConfig, frames: int) -> float:
    """Of the training, that is over."""
    return min(1.0, frames / cfg.collector.total_frames)
