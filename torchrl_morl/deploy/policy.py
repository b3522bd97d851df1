"""A policy: what a trained actor is, beside its weights, and how it is asked for a command."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from tensordict.nn import TensorDictSequential
from torch import Tensor, nn
from torch.nn.functional import linear

from torchrl_morl.preferences import PreferenceSpace
from torchrl_morl.transforms import check_finite

from .entries import one_line
from .features import RowFeatures
from .onnx_runner import TOLERANCE
from .sensing import (
    LARGEST,
    NUM_MOTION,
    NUM_ROBOT,
    SMALLEST,
    Limits,
    Sensing,
    check_robot_numbers,
)

__all__ = ["Policy"]

_NUMPY = {torch.float32: np.float32, torch.float64: np.float64}


@dataclasses.dataclass(frozen=True, eq=False)
class Policy:
    """A trained policy, as :func:`load_policy` returns it.

    Args:
        actor: the network alone: features and preference in, action in [-1, 1] out. In an environment
            made by ``envs.policy_env.make_policy_env`` it is all that is needed. That of
            :func:`load_policy` refuses a preference off the simplex, in eager mode; compiled or
            exported it checks sizes and precision alone.
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
        robot: ArrayLike | Tensor | None = None,
        motion: ArrayLike | Tensor | None = None,
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
            robot: which robot it drives, ``[*B, 6]``, see
                :func:`torchrl_morl.deploy.features.observation`; its limits are then those of the
                command. For policies that read it.
            motion: how it moves, ``[*B, 10]``: measured speed (m/s) and turn rate (rad/s), then those of
                the last four commands, the latest first. For policies that read it.

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
        if sensing.observe_nobody:
            given["nobody"] = (0.0,)  # the place of the mark, which is set below
        if sensing.observe_robot:
            given["robot"] = sensing.robot(robot) if robot is None else robot
        elif robot is not None:
            sensing.robot(robot)  # refuses it
        if sensing.observe_motion:
            if motion is None:
                raise ValueError(
                    "this policy reads how the robot moves: give motion=, measured speed and turn rate "
                    "and the last four commands, or odometry= to PolicyRunner.step."
                )
            given["motion"] = motion
        elif motion is not None:
            raise ValueError(
                "this policy does not read motion=, sensing.observe_motion is false: leave it out."
            )
        given["preference"] = preference
        tensors = any([isinstance(value, Tensor) for value in given.values()])
        with torch.inference_mode():
            row = self._checked(given, tensors)
            if sensing.observe_nobody:
                self._features.mark_nobody(row)
            action = self._features(row)
            if torch.is_autocast_enabled(action.device.type):
                action = self.actor[0].module(action)
            else:
                # Without the bookkeeping of Module.__call__ and of attributes, a third of the time of
                # one observation.
                for layer in self._layers:
                    action = layer(action)
            action = action.tanh()
            if sensing.observe_robot:
                limits = self._features.robot_of(row)[..., 1:3]
                # Forwards from 0, turns to both sides.
                action = (
                    action * action.new_tensor((0.5, 1.0)) + action.new_tensor((0.5, 0.0))
                ) * limits
            else:
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
        return [_bare(layer) for layer in self.actor[0].module]

    @functools.cached_property
    def _features(self) -> RowFeatures:
        return RowFeatures(self.sensing, self.preference_space.num_tunable, self._like)

    @functools.cached_property
    def _middle_and_half(self) -> tuple[Tensor, Tensor]:
        """Of the commands: the middle of their range, and half of it."""
        limits = self.limits
        low, high = self._like.new_tensor((limits.speed, limits.turn_rate)).T
        return (high + low) / 2, (high - low) / 2

    @functools.cached_property
    def _sizes(self) -> dict[str, int]:
        return {
            "lidar": self.sensing.num_sectors,
            "goal": 2,
            "human": 2,
            "human_velocity": 2,
            "nobody": 1,
            "robot": NUM_ROBOT,
            "motion": NUM_MOTION,
            "preference": self.preference_space.num_tunable,
        }

    def _checked(self, given: Mapping[str, Any], tensors: bool) -> Tensor:
        """Inputs in a row, with distances in the trained range, and behind them what else was checked."""
        like, sizes = self._like, self._sizes
        dtype = like.dtype if tensors else _NUMPY[like.dtype]
        inputs, batches = {}, set()
        for name, value in given.items():
            try:
                if isinstance(value, np.ma.MaskedArray):
                    # Not finite, which is refused below: what stands behind a mask is no reading.
                    value = np.ma.filled(value.astype(np.float64), np.nan)
                value = torch.as_tensor(value) if tensors else np.asarray(value)
            except (TypeError, ValueError, RuntimeError) as error:
                raise ValueError(f"{name} is no array of numbers: {one_line(error)}.") from error
            if not (_is_numeric(value) if tensors else value.dtype.kind in "fiub"):
                raise ValueError(f"{name} is no array of numbers: it is {_kind(value)}.")
            value = value.to(like.device, dtype) if tensors else value.astype(dtype, copy=False)
            shape = value.shape
            if not shape or shape[-1] != sizes[name]:
                raise ValueError(f"{name} must have shape [..., {sizes[name]}], got {list(shape)}.")
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
        preference = inputs["preference"]
        if tensors:
            checked = [*inputs.values(), preference.sum(-1, keepdim=True)]
            if self.sensing.observe_robot:
                checked += [_room(inputs["robot"])]
            everything = torch.cat(checked, -1)
        else:
            checked = [*inputs.values(), preference.sum(-1, keepdims=True)]
            if self.sensing.observe_robot:
                checked += [_room(inputs["robot"])]
            everything = torch.from_numpy(np.concatenate(checked, -1))
            if like.device.type != "cpu":
                everything = everything.to(like.device)
        low, high, trained = self._bounds
        clamped = everything.clamp(low, trained)
        # Equal only if nothing is NaN or out of bounds; what is wrong is then looked for.
        as_trained = torch.equal(clamped, everything)
        if not as_trained and not torch.equal(everything.clamp(low, high), everything):
            widths = [value.shape[-1] for value in checked]
            self._refuse(dict(zip(inputs, everything.split(widths, -1))))
        return clamped

    def _refuse(self, inputs: Mapping[str, Tensor]) -> None:
        """Say what is wrong with them.

        Raises:
            ValueError: for the first thing.
        """
        check_finite(inputs, list(inputs))
        self.preference_space.validate(inputs["preference"], tol=TOLERANCE)
        for name, value in inputs.items():
            lengths = value if name == "lidar" else value[..., :1]
            if name == "robot":
                for one in value.reshape(-1, NUM_ROBOT).tolist():
                    check_robot_numbers(one)
                continue
            if name not in ("human_velocity", "motion") and lengths.min() < 0:
                raise ValueError(
                    f"{name} has the length {lengths.min():g} m: it must not be negative."
                )

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
        if sensing.observe_nobody:
            rows += [(0.0, 1.0, 1.0)]
        if sensing.observe_robot:
            # Radius, speed, turn rate, view and range are above zero.
            rows += [(SMALLEST, most, most) for most, _ in LARGEST.values()]
            rows += [(-huge, huge, huge)]
        if sensing.observe_motion:
            rows += [(-huge, huge, huge)] * NUM_MOTION
        rows += [(0.0, huge, huge)] * self.preference_space.num_tunable
        rows += [(1 - TOLERANCE, 1 + TOLERANCE, 1 + TOLERANCE)]  # the sum of the preference
        if sensing.observe_robot:
            rows += [(0.0, huge, huge)]
        low, high, trained = self._like.new_tensor(rows).T.contiguous()
        return low, high, trained


def _room(robot: Any) -> Any:
    """How far within its hull the lidar of a robot is."""
    return robot[..., :1] - abs(robot[..., -1:])


def _bare(layer: nn.Module) -> Callable[[Tensor], Tensor]:
    """What a layer computes, without its bookkeeping. Parameters are always the present ones."""
    parameters = layer._parameters
    if not isinstance(layer, nn.Linear) or parameters.keys() != {"weight", "bias"}:
        return layer.forward
    # Not a closure: copies of a policy must take their own parameters along.
    return functools.partial(_linear, parameters)


def _linear(parameters: Mapping[str, Tensor], features: Tensor) -> Tensor:
    return linear(features, parameters["weight"], parameters["bias"])


def _is_numeric(value: Tensor) -> bool:
    """Whether a tensor is of real numbers, which are there and not quantized."""
    if value.is_nested or value.is_meta or value.is_quantized or value.layout is not torch.strided:
        return False
    return not value.dtype.is_complex


def _kind(value: np.ndarray | Tensor) -> str:
    if isinstance(value, Tensor) and value.is_nested:
        return "nested"
    if isinstance(value, Tensor) and value.layout is not torch.strided:
        return str(value.layout)
    return "on the meta device" if isinstance(value, Tensor) and value.is_meta else str(value.dtype)
