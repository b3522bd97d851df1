"""What a network is, apart from its weights: read from the module when saved, and built again."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tensordict.utils import NestedKey
from torch import nn

from .entries import Entries

ACTIVATIONS: dict[str, type[nn.Module]] = {
    activation.__name__: activation
    for activation in (
        nn.ELU,
        nn.GELU,
        nn.LeakyReLU,
        nn.ReLU,
        nn.SELU,
        nn.SiLU,
        nn.Sigmoid,
        nn.Softplus,
        nn.Tanh,
    )
}
"""Those that a file can name, with their default arguments."""


def describe_mlp(mlp: nn.Module) -> dict[str, Any]:
    """Sizes and activation of a multi-layer perceptron.

    Raises:
        ValueError: if it has no linear layer, or several kinds of activations.
    """
    layers = list(mlp.children())
    linear = [layer for layer in layers if isinstance(layer, nn.Linear)]
    if not linear:
        raise ValueError(f"{type(mlp).__name__} has no linear layer: it cannot be restored.")
    others = sorted({type(layer).__name__ for layer in layers if layer not in linear})
    if len(others) > 1 or any(name not in ACTIVATIONS for name in others):
        raise ValueError(
            f"the network has {', '.join(others)} between its linear layers and cannot be restored: "
            f"use one of {', '.join(ACTIVATIONS)} everywhere."
        )
    return {
        "in_features": linear[0].in_features,
        "num_cells": [layer.out_features for layer in linear[:-1]],
        "activation": others[0] if others else "ReLU",
    }


def check_restorable(module: nn.Module, rebuilt: nn.Module) -> None:
    """Refuse a module that what is built from its description does not equal.

    Raises:
        ValueError: if they differ in more than their weights.
    """
    ours, theirs = (
        {name: (type(part), part.extra_repr()) for name, part in m.named_modules()}
        for m in (module, rebuilt)
    )
    for name in ours.keys() | theirs.keys():
        if ours.get(name) != theirs.get(name):
            raise ValueError(
                f"{name or type(module).__name__} is {_shown(ours.get(name))} and would be restored "
                f"as {_shown(theirs.get(name))}: it cannot be saved."
            )
    for name, part in module.named_modules():
        if part._forward_hooks or part._forward_pre_hooks:
            raise ValueError(
                f"{name or type(module).__name__} has a forward hook, which would be lost: remove "
                "it before saving."
            )
    if module.state_dict().keys() != rebuilt.state_dict().keys():
        names = sorted(module.state_dict().keys() ^ rebuilt.state_dict().keys())
        raise ValueError(f"{names[0]} would be lost: the module cannot be saved.")


def keys_to_json(keys: Sequence[NestedKey]) -> list[str | list[str]]:
    """Keys as JSON values: nested ones are lists."""
    return [key if isinstance(key, str) else list(key) for key in keys]


def keys_from_json(entries: Entries, name: str) -> list[NestedKey]:
    """The keys that :func:`keys_to_json` wrote.

    Raises:
        ValueError: if they are something else.
    """
    value = entries[name]
    if type(value) is not list or not value:
        raise entries.refused(name, "a list of keys")
    keys = []
    for key in value:
        parts = [key] if type(key) is str else key
        if type(parts) is not list or not parts:
            raise entries.refused(name, "a list of keys")
        if not all(type(part) is str and part and part.isprintable() for part in parts):
            raise entries.refused(name, "a list of keys, each a string or a list of strings")
        keys.append(parts[0] if len(parts) == 1 else tuple(parts))
    return keys


def _shown(part: tuple[type, str] | None) -> str:
    return "missing" if part is None else f"{part[0].__name__}({part[1]})"
