"""Gradients of the networks, compiled or not, in float32 or by automatic mixed precision."""

from __future__ import annotations

import contextlib
import functools
import os
import shutil
import warnings
from collections.abc import Callable, Iterator, Sequence

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch._dynamo.variables import constant

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


@contextlib.contextmanager
def tracing_backward() -> Iterator[None]:
    """PyTorch traces a backward pass only if told to: in here, and nowhere else in the process.

    Tracing ``.grad`` of parameters, PyTorch 2.13 notes in the one ``None`` that all graphs share where
    it has read it, and whatever is compiled next fails where it writes ``None``: it forgets that, too.
    """
    with torch._dynamo.config.patch(trace_autograd_ops=True):
        try:
            yield
        finally:
            for name in ("NONE", "TRUE", "FALSE"):  # which another version need not share
                shared = getattr(constant, f"CONSTANT_VARIABLE_{name}", None)
                if shared is not None:
                    shared.source = None


def _compiled(cfg: DictConfig, function: Gradients) -> Gradients:
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
    # Isolated: critics and actor have their gradients from the same code, and neither's graph is to be
    # held against the guards of the other's.
    compiled = torch.compile(
        function,
        fullgraph=True,
        isolate_recompiles=True,
        options={
            **torch._inductor.list_mode_options(cfg.compute.compile_mode),
            "guard_filter_fn": _guards,
        },
    )

    @functools.wraps(function)
    def run(batch: TensorDictBase) -> dict[str, Tensor]:
        with tracing_backward():
            return compiled(batch)

    return run


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
    precision = torch.autocast(
        device.type, torch.bfloat16, enabled=use_bfloat16(cfg.compute.bfloat16, device)
    )

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
