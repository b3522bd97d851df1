"""The gradients that the recipe of PD-MORL computes, compiled or not."""

from __future__ import annotations

import sys

import pytest
import torch

from benchmarks.workload import config, make_task, transitions
from recipes.training import gradients
from recipes.training.agent import make_actor
from recipes.training.loss import make_loss


def small_loss(*overrides: str):
    """The loss of the recipe, and its configuration."""
    small = ("network.num_cells=[8]", "env.num_envs=4", "compute.compile=true")
    cfg = config(*small, *overrides)
    task = make_task(cfg)
    loss = make_loss(cfg, task, make_actor(cfg, task))
    task.env.close()
    return cfg, loss


def test_without_a_compiler_the_training_says_so(monkeypatch):
    monkeypatch.setenv("CXX", "no-such-compiler")
    monkeypatch.setattr(torch, "compile", None)
    with pytest.warns(UserWarning, match="no-such-compiler is not installed"):
        functions = gradients.make_gradients(*small_loss())
    assert len(functions) == 2


def test_compiled_as_asked_for(monkeypatch):
    asked = []
    monkeypatch.setattr(torch, "compile", lambda function, **options: asked.append(options))
    monkeypatch.setenv("CXX", sys.executable)
    gradients.make_gradients(*small_loss("compute.compile_mode=reduce-overhead"))
    assert [call["options"]["triton.cudagraphs"] for call in asked] == [True] * 2
    assert all(call["fullgraph"] for call in asked)


def test_an_unknown_mode_is_refused(monkeypatch):
    monkeypatch.setenv("CXX", sys.executable)
    with pytest.raises(RuntimeError, match=r"fastest.*reduce-overhead"):
        gradients.make_gradients(*small_loss("compute.compile_mode=fastest"))


@pytest.fixture
def eager_backend(monkeypatch) -> list[int]:
    """Compiles to graphs that run without a C++ compiler; how many graphs there are in the end."""
    compile_with = torch.compile
    graphs = []

    def count(graph, example_inputs):
        graphs.append(len(example_inputs))
        return graph.forward

    def compiled(function, options, **others):
        only = {"guard_filter_fn": options["guard_filter_fn"]}
        return compile_with(function, backend=count, options=only, **others)

    monkeypatch.setenv("CXX", sys.executable)
    monkeypatch.setattr(torch, "compile", compiled)
    torch._dynamo.reset()
    return graphs


def test_what_is_checked_at_every_update(eager_backend, monkeypatch):
    """Not the modules, thousands of checks; but the tensors, and the number of threads."""
    kept = []
    choose = gradients._guards

    def counting(guards):
        chosen = choose(guards)
        kept.append(sum(chosen))
        return chosen

    monkeypatch.setattr(gradients, "_guards", counting)
    run, _ = gradients.make_gradients(*small_loss())
    for size in (16, 16, 8):
        run(transitions(1000)[:size])
    assert len(eager_backend) == 2, "one graph of each size"
    assert max(kept) < 200
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(threads + 1)
        run(transitions(1000)[:8])
    finally:
        torch.set_num_threads(threads)
    assert len(eager_backend) == 3


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("network", ["qvalue", "actor"])
def test_gradients_are_those_of_the_loss(network, compiled, request):
    """Of this batch alone, clipped, and of one network alone; twice, since gradients add up."""
    if compiled:
        request.getfixturevalue("eager_backend")
    cfg, loss = small_loss("optim.max_grad_norm=0.05", f"compute.compile={compiled}".lower())
    run = dict(zip(("qvalue", "actor"), gradients.make_gradients(cfg, loss), strict=True))[network]
    other = "actor" if network == "qvalue" else "qvalue"
    networks = {
        name: [
            parameter
            for parameter in getattr(loss, f"{name}_network_params").flatten_keys().values()
            if parameter.requires_grad
        ]
        for name in (network, other)
    }
    batch = transitions(16)
    for seed in range(2):
        torch.manual_seed(seed)
        metadata = run(batch.clone())
        torch.manual_seed(seed)
        value, _ = (loss.value_loss if network == "qvalue" else loss.actor_loss)(batch.clone())
        expected = torch.autograd.grad(value, networks[network])
        norm = torch.stack([gradient.square().sum() for gradient in expected]).sum().sqrt()
        assert norm > 0.05, "nothing to clip"
        torch.testing.assert_close(metadata[f"loss_{network}"], value.detach())
        torch.testing.assert_close(metadata[f"grad_norm_{network}"], norm)
        for parameter, gradient in zip(networks[network], expected, strict=True):
            torch.testing.assert_close(parameter.grad, gradient * 0.05 / norm, rtol=1e-4, atol=1e-6)
        assert all(parameter.grad is None for parameter in networks[other])


def test_what_is_compiled_afterwards_compiles(eager_backend):
    """Whatever else the process does: nothing of the training is left in PyTorch's compiler."""
    run, _ = gradients.make_gradients(*small_loss())
    run(transitions(16))
    assert not torch._dynamo.config.trace_autograd_ops

    class Box:
        value = "full"

    box = Box()

    def empty(x: torch.Tensor) -> torch.Tensor:
        box.value = None
        return x + 1

    every = {"guard_filter_fn": lambda guards: [True] * len(guards)}
    assert torch.compile(empty, fullgraph=True, options=every)(torch.zeros(())) == 1
    assert box.value is None
