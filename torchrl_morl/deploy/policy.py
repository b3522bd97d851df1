"""Policies: what a trained actor is, beside its weights, and how it is asked for a command."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from tensordict.nn import TensorDictSequential
from torch import Tensor
from torchrl.data import Bounded

from torchrl_morl.modules import make_actor
from torchrl_morl.preferences import PreferenceSpace
from torchrl_morl.transforms import check_finite

from . import format1
from .features import observation
from .files import Entries, count_tensors, one_line, paths, read_config, read_weights, write_module
from .networks import (
    ACTIVATIONS,
    check_restorable,
    describe_mlp,
    keys_from_json,
    keys_to_json,
)
from .sensing import Limits, Sensing

__all__ = ["Policy", "load_policy", "save_policy"]

_KIND = "policy"
_NUMPY = {torch.float32: np.float32, torch.float64: np.float64}
_TOLERANCE = 1e-4
"""How far the sum of a preference may be from one."""


@dataclasses.dataclass(frozen=True, eq=False)
class Policy:
    """A trained policy, as :func:`load_policy` returns it.

    Args:
        actor: the network alone: features and preference in, action in [-1, 1] out. It checks
            nothing. In an environment made by ``envs.policy_env.make_policy_env`` it is all that is
            needed.
        preference_space: what the entries of a preference mean.
        sensing: what it was trained to sense; ``None`` if its file does not tell.
        limits: of its commands.
        period: of a control step in training, seconds.
        robot: the one that it was trained with.
        card: whatever else is known of it.
    """

    actor: TensorDictSequential
    preference_space: PreferenceSpace
    sensing: Sensing | None
    limits: Limits
    period: float
    robot: str
    card: dict[str, Any]

    def act(
        self,
        *,
        preference: ArrayLike | Tensor,
        lidar: ArrayLike | Tensor,
        goal: ArrayLike | Tensor,
        human: ArrayLike | Tensor | None = None,
        human_velocity: ArrayLike | Tensor | None = None,
    ) -> np.ndarray | Tensor:
        """Command for what is sensed, in physical units. Arrays, lists or tensors, of any dtype.

        Distances beyond the trained range are clamped to it. A robot needs more than this call:
        :class:`PolicyRunner` pools scans, stops at the goal, and stops when an input is missing.

        Keyword Args:
            preference: weights of the tunable objectives, on the simplex, ``[*B, T]``.
            lidar: shortest range of each sector, ``[*B, num_sectors]``, metres.
            goal: distance (m) and bearing (rad) from the robot, ``[*B, 2]``.
            human: the same of the human; ``None`` if there is nobody.
            human_velocity: of the human over the ground, along the robot's axes, ahead and to the
                left, ``[*B, 2]``, m/s. For policies that read it.

        Returns:
            Forward speed (m/s) and turn rate (rad/s), ``[*B, 2]``: a tensor if an input is one,
            otherwise an array. Inputs are broadcast against each other.

        Raises:
            ValueError: for an input that is missing, of another shape, not finite, or negative where
                it must not be; for a preference off the simplex; for an output that is not finite.

        Example:
            In a clone ``load_policy("recipes/policies/navigation")`` is a trained one.

            >>> from torchrl_morl.testing import untrained_policy
            >>> policy = untrained_policy()
            >>> policy.preference_space.tunable
            ('demo', 'distance', 'efficiency')
            >>> speed, turn_rate = policy.act(
            ...     preference=[0, 0, 1], lidar=[4.0] * 30, goal=[6.0, 0.5], human=[8.0, 3.0]
            ... )
            >>> bool(0.0 <= speed <= 0.5), bool(-3.15 < turn_rate < 3.15)
            (True, True)
        """
        sensing = self.sensing
        if sensing is None:
            raise ValueError(
                "the file of this policy does not tell what it senses: save it again with "
                "sensing=Sensing(...), or use its actor."
            )
        given = {"lidar": lidar, "goal": goal}
        if sensing.observe_human:
            given["human"] = sensing.nobody if human is None else human
        if sensing.observe_human_velocity:
            if human_velocity is None and human is not None:
                raise ValueError(
                    "this policy reads the human's velocity: give human_velocity=, ahead and to "
                    "the left in m/s, or odometry= to PolicyRunner.step."
                )
            given["human_velocity"] = (0.0, 0.0) if human_velocity is None else human_velocity
        given["preference"] = preference
        tensors = any([isinstance(value, Tensor) for value in given.values()])
        with torch.inference_mode():
            inputs = self._checked(given, tensors)
            preference = inputs.pop("preference")
            features = observation(sensing, **inputs)
            action = torch.cat((features, preference), -1)
            # Without the bookkeeping of Module.__call__, a fifth of the time of one observation.
            for layer in self._layers:
                action = layer(action)
            action = action.tanh()
            middle, half = self._middle_and_half
            action = torch.addcmul(middle, half, action)
            if not math.isfinite(action.sum()):
                raise ValueError(
                    f"the policy's command is not finite, {action.tolist()}: its weights are of no "
                    "use for these inputs."
                )
            if not tensors:
                return action.numpy(force=True)
        return action.clone()  # a normal tensor, not one of inference

    @functools.cached_property
    def _like(self) -> Tensor:
        return next(self.actor.parameters())

    @functools.cached_property
    def _layers(self) -> list[Callable[[Tensor], Tensor]]:
        return [layer.forward for layer in self.actor[0].module]

    @functools.cached_property
    def _middle_and_half(self) -> tuple[Tensor, Tensor]:
        """Of the commands: the middle of their range, and half of it."""
        limits = self.limits
        low, high = self._like.new_tensor((limits.speed, limits.turn_rate)).T
        return (high + low) / 2, (high - low) / 2

    def _checked(self, given: Mapping[str, Any], tensors: bool) -> dict[str, Tensor]:
        """Inputs as tensors of one batch shape, with distances in the trained range."""
        like = self._like
        sizes = {"lidar": self.sensing.num_sectors, "preference": self.preference_space.num_tunable}
        dtype = like.dtype if tensors else _NUMPY[like.dtype]
        inputs, batches = {}, set()
        for name, value in given.items():
            try:
                value = torch.as_tensor(value) if tensors else np.asarray(value)
            except (TypeError, ValueError, RuntimeError) as error:
                raise ValueError(f"{name} is no array of numbers: {one_line(error)}.") from error
            if value.dtype.is_complex if tensors else value.dtype.kind not in "fiub":
                raise ValueError(f"{name} is no array of numbers: it is {value.dtype}.")
            value = value.to(like.device, dtype) if tensors else value.astype(dtype, copy=False)
            shape = value.shape
            if not shape or shape[-1] != sizes.get(name, 2):
                raise ValueError(
                    f"{name} must have shape [..., {sizes.get(name, 2)}], got {list(shape)}."
                )
            inputs[name] = value
            batches.add(shape[:-1])
        if len(batches) > 1:
            try:
                batch = torch.broadcast_shapes(*batches)
            except RuntimeError as error:
                shapes = ", ".join(f"{n} {list(value.shape)}" for n, value in inputs.items())
                raise ValueError(f"batch shapes do not go together: {shapes}.") from error
            expand = torch.Tensor.expand if tensors else np.broadcast_to
            inputs = {n: expand(value, (*batch, value.shape[-1])) for n, value in inputs.items()}
        sizes = [sizes.get(name, 2) for name in inputs]
        if tensors:
            everything = torch.cat(list(inputs.values()), -1)
        else:
            everything = torch.from_numpy(np.concatenate(list(inputs.values()), -1)).to(like.device)
        total = everything.narrow(-1, -sizes[-1], sizes[-1]).sum(-1, keepdim=True)
        everything = torch.cat((everything, total), -1)
        low, high, trained = self._bounds
        # Equal only if nothing is NaN or out of bounds; what is wrong is then looked for.
        if not torch.equal(everything.clamp(low, high), everything):
            inputs = dict(zip(inputs, everything[..., :-1].split(sizes, -1)))
            check_finite(inputs, list(inputs))
            self.preference_space.validate(inputs["preference"], tol=_TOLERANCE)
            for name, value in inputs.items():
                lengths = value if name == "lidar" else value[..., :1]
                if name != "human_velocity" and lengths.min() < 0:
                    raise ValueError(
                        f"{name} has the length {lengths.min():g} m: it must not be negative."
                    )
        return dict(zip(inputs, everything.clamp(max=trained).split([*sizes, 1], -1)))

    @functools.cached_property
    def _bounds(self) -> tuple[Tensor, Tensor, Tensor]:
        """Of the inputs in a row: lowest and highest that are allowed, and what they are clamped to."""
        sensing, huge = self.sensing, torch.finfo(self._like.dtype).max
        rows = [(0.0, huge, sensing.max_range)] * sensing.num_sectors
        rows += [(0.0, huge, sensing.goal_range[1]), (-huge, huge, huge)]
        if sensing.observe_human:
            rows += [(0.0, huge, sensing.human_range[1]), (-huge, huge, huge)]
        if sensing.observe_human_velocity:
            rows += [(-huge, huge, huge)] * 2
        rows += [(0.0, huge, huge)] * self.preference_space.num_tunable
        rows += [(1 - _TOLERANCE, 1 + _TOLERANCE, huge)]  # the sum of the preference
        low, high, trained = self._like.new_tensor(rows).T.contiguous()
        return low, high, trained


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


def load_policy(folder: str | Path, device: torch.device | str | None = None) -> Policy:
    """Read a policy written by :func:`save_policy`.

    Args:
        folder: with ``policy.safetensors`` and ``policy.json``, also of earlier versions.
        device: where to put the actor.

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
    return Policy(actor, preference_space, sensing, limits, period, robot, card)


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
