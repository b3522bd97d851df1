"""Optimizers and their schedules."""

from __future__ import annotations

import math

import torch
from omegaconf import DictConfig
from torch import Tensor, nn
from torchrl.objectives import LossModule


def make_optimizers(
    cfg: DictConfig, loss: LossModule
) -> tuple[dict[str, torch.optim.Optimizer], dict[str, torch.optim.lr_scheduler.LRScheduler]]:
    """Adam for each network, with a cosine from ``lr`` to ``final_lr_ratio * lr``."""
    optimizers = {
        "actor": torch.optim.Adam(
            loss.actor_network_params.flatten_keys().values(), lr=cfg.optim.lr, fused=True
        ),
        "critic": torch.optim.Adam(
            loss.qvalue_network_params.flatten_keys().values(), lr=cfg.optim.lr, fused=True
        ),
    }
    batches = cfg.collector.total_frames / cfg.collector.frames_per_batch

    def decay(batch: int) -> float:
        share = min(1.0, batch / batches)
        ratio = cfg.optim.final_lr_ratio
        return ratio + (1 - ratio) * 0.5 * (1 + math.cos(math.pi * share))

    schedulers = {
        f"{name}_schedule": torch.optim.lr_scheduler.LambdaLR(optimizer, decay)
        for name, optimizer in optimizers.items()
    }
    return optimizers, schedulers


def step(optimizer: torch.optim.Optimizer, loss: Tensor, max_grad_norm: float) -> dict[str, Tensor]:
    """One optimizer step with clipped gradients; returns the gradient's norm before clipping."""
    optimizer.zero_grad(set_to_none=True)
    loss.backward()
    parameters = [p for group in optimizer.param_groups for p in group["params"]]
    norm = nn.utils.clip_grad_norm_(parameters, max_grad_norm)
    optimizer.step()
    return {"grad_norm": norm.detach()}
