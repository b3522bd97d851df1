"""Policies as files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictSequential
from tensordict.utils import NestedKey
from torchrl.data import Bounded

from torchrl_morl.arguments import check_device
from torchrl_morl.modules import make_actor
from torchrl_morl.preferences import PreferenceSpace

from . import format1
from .entries import Entries, named
from .files import count_tensors, paths, read_config, read_weights, write_module
from .networks import (
    ACTIVATIONS,
    check_restorable,
    describe_mlp,
    keys_from_json,
    keys_to_json,
)
from .policy import Policy
from .sensing import Limits, Sensing

__all__ = ["load_policy", "save_policy"]

_KIND = "policy"


def save_policy(
    folder: str | Path,
    actor: TensorDictSequential,
    *,
    preference_space: PreferenceSpace,
    sensing: Sensing | None = None,
    limits: Limits | None = None,
    period: float = 0.2,
    robot: str = "unknown",
    card: Mapping[str, Any],
) -> Path:
    """Write an actor made by :func:`~torchrl_morl.modules.make_actor` to a folder.

    Sizes, keys, activation and dtype are read from the actor. What could not be restored is refused.

    Args:
        folder: must not exist, or be empty; it appears whole or not at all.
        actor: its action is in [-1, 1].

    Keyword Args:
        preference_space: what the entries of the preference mean.
        sensing: what the policy was trained to sense; without it only the actor can be used.
        limits: what -1 and 1 of the action mean.
        period: of a control step, seconds.
        robot: that it was trained with.
        card: whatever a reader should know (environment, training configuration, versions,
            results), as JSON values. NaN and infinity, which JSON does not know, become null.

    Returns:
        The folder.

    Raises:
        FileExistsError: if the folder holds something already.
        ValueError: for an actor that the files could not restore: another architecture, mixed
            activations, bounds that are not [-1, 1], a forward hook, half precision; or one that does not fit
            ``sensing`` and ``preference_space``.
    """
    config = {
        "objectives": list(preference_space.objectives),
        "static": dict(preference_space.static),
        "network": _describe(actor),
        "sensing": None if sensing is None else sensing.to_json(),
        "limits": (limits or Limits()).to_json(),
        "period": period,
        "robot": robot,
        "card": dict(card),
    }
    _check_fit(config["network"], sensing, preference_space)
    check_restorable(actor, _build(Entries(config, "policy").object("network")))
    return write_module(folder, _KIND, actor, config)


def load_policy(
    folder: str | Path,
    device: torch.device | str | None = None,
    *,
    check_preferences: bool = True,
) -> Policy:
    """Read a policy written by :func:`save_policy`.

    Args:
        folder: with ``policy.safetensors`` and ``policy.json``, also of earlier versions.
        device: where to put the actor.

    Keyword Args:
        check_preferences: whether its actor refuses preferences off the simplex, in eager mode. On an
            accelerator that waits for the device. A training that goes on from the actor does without.

    Returns:
        The policy. Its actor is in evaluation mode, without gradients.

    Raises:
        FileNotFoundError: if a file is missing.
        ValueError: if a file is not what it should be: broken, changed, of another format, or with
            weights that are not finite or do not fit the configuration. In one line.

    Example:
        >>> import tempfile
        >>> from torchrl_morl.testing import untrained_policy
        >>> untrained = untrained_policy()
        >>> with tempfile.TemporaryDirectory() as parent:
        ...     folder = save_policy(
        ...         f"{parent}/policy",
        ...         untrained.actor,
        ...         preference_space=untrained.preference_space,
        ...         sensing=untrained.sensing,
        ...         robot="turtlebot2",
        ...         card={"trained": False},
        ...     )
        ...     policy = load_policy(folder)
        >>> policy.robot, policy.period, policy.sensing.max_range
        ('turtlebot2', 0.2, 4.0)
    """
    check_device("device", device)
    config = read_config(folder, _KIND)
    where = str(paths(folder, _KIND)[1])
    names, static = config.texts("objectives"), config.object("static")
    weights = {name: static.number(name) for name in static}
    try:
        preference_space = PreferenceSpace(names, static=weights)
    except ValueError as error:
        raise ValueError(f"{where} describes no policy: {error}") from error
    network = config.object("network") if config["format"] > 1 else _network_of_format1(config)
    depth = len(network.integers("num_cells"))
    if count_tensors(folder, _KIND) != 2 * (depth + 1) + 2:
        raise ValueError(
            f"{paths(folder, _KIND)[0]} does not fit {_KIND}.json: it should have "
            f"{2 * (depth + 1) + 2} entries, for {depth} hidden layers, and has another number."
        )
    with named(network.where):
        actor = _build(network)
    card = config.plain("card")
    if config["format"] > 1:
        sensing = None
        if config.get("sensing") is not None:
            sensing = _record(where, Sensing, config.object("sensing"))
        limits = _record(where, Limits, config.object("limits"))
        period, robot = config.number("period"), config.text("robot")
        if period <= 0:
            raise config.refused("period", "positive")
    else:
        card = format1.renamed(card)
        sensing, limits, robot = format1.sensing_of(card, where) or (None, Limits(), "unknown")
        period = format1.PERIOD
    try:
        _check_fit(network, sensing, preference_space)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error
    read_weights(folder, _KIND, actor, config)
    low, high = actor[1].buffers()
    if not ((low == -1).all() and (high == 1).all()):
        raise ValueError(f"{where} describes no policy: its actions are not in [-1, 1].")
    actor.requires_grad_(False).eval().to(device)
    if check_preferences and (key := _preference_key(actor, sensing)) is not None:
        actor[0].module.check_preferences(key, preference_space)
    return Policy(actor, preference_space, sensing, limits, period, robot, card)


def _preference_key(actor: TensorDictSequential, sensing: Sensing | None) -> NestedKey | None:
    """The actor's input that is the preference, if that can be told."""
    keys = list(actor[0].in_keys)
    if sensing is not None:
        return keys[-1]
    named = [key for key in keys if "preference" in (key, key[-1])]
    return named[0] if len(named) == 1 else None


def _describe(actor: TensorDictSequential) -> dict[str, Any]:
    try:
        first, second = actor
        mlp, in_keys, pre_tanh_key = first.module, first.in_keys, first.out_keys[0]
        low, high = second.buffers()
        (out_key,) = second.out_keys
    except (AttributeError, TypeError, ValueError) as error:
        raise ValueError("the actor is not one of make_actor: it cannot be restored.") from error
    if not ((low == -1).all() and (high == 1).all()):
        raise ValueError(
            f"the actions of a saved actor are in [-1, 1], got {low.tolist()} to {high.tolist()}: "
            "what they mean is said by limits=."
        )
    return {
        **describe_mlp(mlp),
        "action_size": low.shape[-1],
        "in_keys": keys_to_json(in_keys),
        "pre_tanh_key": keys_to_json([pre_tanh_key])[0],
        "out_key": keys_to_json([out_key])[0],
    }


def _network_of_format1(config: Entries) -> Entries:
    tunable = len(config.texts("objectives")) - len(config.object("static"))
    network = {
        "in_features": config.integer("observation_size") + tunable,
        "action_size": config.integer("action_size"),
        "num_cells": list(config.integers("num_cells")),
        "activation": "ReLU",
        "in_keys": ["observation", "preference"],
        "pre_tanh_key": "pre_tanh",
        "out_key": "action",
    }
    return Entries(network, config.where)


def _build(network: Entries) -> TensorDictSequential:
    """The actor of a description, without weights."""
    single = Entries({key: [network[key]] for key in ("pre_tanh_key", "out_key")}, network.where)
    return make_actor(
        Bounded(-1.0, 1.0, shape=(network.integer("action_size", high=10_000),)),
        in_features=network.integer("in_features"),
        in_keys=keys_from_json(network, "in_keys"),
        num_cells=network.integers("num_cells"),
        activation_class=ACTIVATIONS[network.choice("activation", tuple(ACTIVATIONS))],
        pre_tanh_key=keys_from_json(single, "pre_tanh_key")[0],
        out_key=keys_from_json(single, "out_key")[0],
        device="meta",
    )


def _check_fit(network: Mapping, sensing: Sensing | None, space: PreferenceSpace) -> None:
    if sensing is None:
        return
    expected = sensing.observation_size + space.num_tunable
    if network["in_features"] != expected:
        raise ValueError(
            f"the actor reads {network['in_features']} entries, sensing and preference_space have "
            f"{sensing.observation_size} + {space.num_tunable}."
        )
    if network["action_size"] != 2:
        raise ValueError(
            "an actor with sensing= commands a speed and a turn rate, this one has "
            f"{network['action_size']} actions."
        )
    if len(network["in_keys"]) != 2:
        raise ValueError(
            "an actor with sensing= reads the observation, then the preference; "
            f"this one reads {network['in_keys']}."
        )


def _record(where: str, kind: type, entries: Entries) -> Any:
    try:
        return kind.from_json(entries)
    except ValueError as error:
        message = str(error)
        raise ValueError(message if message.startswith(where) else f"{where}: {message}") from error
