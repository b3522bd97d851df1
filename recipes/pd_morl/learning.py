"""How networks are updated: gradients, compiled or not, and the optimizers."""

from __future__ import annotations

import math
import os
import shutil
import warnings
from collections.abc import Callable, Sequence

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torch import Tensor, nn

from torchrl_morl.objectives import MOTD3Loss

Loss = Callable[[TensorDictBase], tuple[Tensor, dict[str, Tensor]]]
"""From a batch to a loss and its metadata."""

Gradients = Callable[[TensorDictBase], dict[str, Tensor]]
"""From a batch to the clipped gradients, which it leaves in the parameters, and to metadata."""


def use_bfloat16(asked: bool | None, device: torch.device) -> bool:
    """Whether updates compute in bfloat16: as asked, else where the processor multiplies it."""
    if asked is not None:
        return asked
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    capabilities = torch.cpu.get_capabilities()
    return bool(capabilities.get("avx512_bf16") or capabilities.get("amx_bf16"))


def _compiled(cfg: DictConfig, function: Callable) -> Callable:
    """One graph of the function, if asked for and if a C++ compiler is there."""
    if not cfg.compute.compile:
        return function
    compiler = os.environ.get("CXX", "g++")
    if cfg.device == "cpu" and shutil.which(compiler) is None:
        warnings.warn(
            f"compute.compile needs a C++ compiler and {compiler} is not installed: the training "
            "runs without, at about two thirds of the speed.",
            stacklevel=2,
        )
        return function
    # PyTorch 2.13 traces a backward pass only if told to.
    torch._dynamo.config.trace_autograd_ops = True
    # Isolated: critics and actor have their gradients from the same code, and neither's graph is to be
    # held against the guards of the other's.
    return torch.compile(
        function,
        fullgraph=True,
        isolate_recompiles=True,
        options={
            **torch._inductor.list_mode_options(cfg.compute.compile_mode),
            "guard_filter_fn": _guards,
        },
    )


def _guards(guards: Sequence) -> list[bool]:
    """Which guards to check at every call: what tensors are like, the number of threads and the like.

    The others, some 2,700, ask whether the modules of the loss are what they were: nobody exchanges
    those during a training, and looking takes a millisecond, a twentieth of an update.
    """
    tensors = torch.compiler.keep_tensor_guards_unsafe(guards)
    return [kept or not guard.name for kept, guard in zip(tensors, guards, strict=True)]


def make_gradients(cfg: DictConfig, loss: MOTD3Loss) -> tuple[Gradients, Gradients]:
    """Gradients of the critics and of the actor.

    Compiled, loss, backward pass and clipping are one graph, without what the autograd engine and a
    second graph would add to each update.
    """
    device = torch.device(cfg.device)
    enabled = use_bfloat16(cfg.compute.bfloat16, device)
    precision = torch.autocast(device.type, torch.bfloat16, enabled=enabled)

    def gradients(network: str, function: Loss) -> Gradients:
        params = getattr(loss, f"{network}_network_params").flatten_keys().values()
        parameters = [parameter for parameter in params if parameter.requires_grad]

        def run(batch: TensorDictBase) -> dict[str, Tensor]:
            for parameter in parameters:
                parameter.grad = None
            with precision:
                value, metadata = function(batch)
            value.backward(inputs=parameters)
            norm = nn.utils.clip_grad_norm_(parameters, cfg.optim.max_grad_norm)
            return metadata | {f"loss_{network}": value.detach(), f"grad_norm_{network}": norm}

        return _compiled(cfg, run)

    return gradients("qvalue", loss.value_loss), gradients("actor", loss.actor_loss)


def make_optimizers(
    cfg: DictConfig, loss: MOTD3Loss
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
