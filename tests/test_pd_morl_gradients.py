"""The gradients that the recipe of PD-MORL computes, compiled or not."""

from __future__ import annotations

import sys

import pytest
import torch

from benchmarks.learner_systems import config, transitions
from recipes.pd_morl import learning, utils


def make_loss(*overrides: str):
    """The loss of the recipe, and its configuration."""
    small = ("network.num_cells=[8]", "env.num_envs=4", "compute.compile=true")
    cfg = config(*small, *overrides)
    space = utils.make_preference_space(with_demonstrations=True)
    env = utils.make_train_env(cfg, utils.make_preference_space(False), None)
    actor, _ = utils.make_policy(cfg, env, space, torch.device("cpu"))
    loss = utils.make_loss(cfg, env, space, actor, torch.device("cpu"))
    env.close()
    return cfg, loss


def test_without_a_compiler_the_training_says_so(monkeypatch):
    monkeypatch.setenv("CXX", "no-such-compiler")
    monkeypatch.setattr(torch, "compile", None)
    with pytest.warns(UserWarning, match="no-such-compiler is not installed"):
        gradients = learning.make_gradients(*make_loss())
    assert len(gradients) == 2


def test_compiled_as_asked_for(monkeypatch):
    asked = []
    monkeypatch.setattr(torch, "compile", lambda function, **options: asked.append(options))
    monkeypatch.setenv("CXX", sys.executable)
    learning.make_gradients(*make_loss("compute.compile_mode=reduce-overhead"))
    assert [options["mode"] for options in asked] == ["reduce-overhead"] * 2
    assert all(options["fullgraph"] for options in asked)


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("network", ["qvalue", "actor"])
def test_gradients_are_those_of_the_loss(network, compiled, monkeypatch):
    """Of this batch alone, clipped, and of one network alone; twice, since gradients add up."""
    if compiled:
        compile_with = torch.compile
        monkeypatch.setenv("CXX", sys.executable)
        monkeypatch.setattr(
            torch,
            "compile",
            lambda function, mode, **options: compile_with(function, backend="eager", **options),
        )
        torch._dynamo.reset()
    cfg, loss = make_loss("optim.max_grad_norm=0.05", f"compute.compile={compiled}".lower())
    run = dict(zip(("qvalue", "actor"), learning.make_gradients(cfg, loss), strict=True))[network]
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
