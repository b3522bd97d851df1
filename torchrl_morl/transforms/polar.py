"""Network features of polar positions."""

from __future__ import annotations

import math
import numbers
from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import dispatch
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs.transforms import ObservationTransform

from torchrl_morl.arguments import key_list
from torchrl_morl.representation import describe
from torchrl_morl.transforms.stored import apart_from_storage

__all__ = ["PolarFeatures", "polar_features"]


def polar_features(position: Tensor, scale: float) -> Tensor:
    """The features of :class:`PolarFeatures` without a tensordict.

    Args:
        position: distance (m) and bearing (rad), ``[*B, 2]``.
        scale: the distance in metres that becomes 1.

    Returns:
        Distance / scale, sine and cosine of the bearing, ``[*B, 3]``.
    """
    distance, bearing = position.unbind(-1)
    return torch.stack([distance / scale, bearing.sin(), bearing.cos()], -1)


class PolarFeatures(ObservationTransform):
    """Turn polar positions (distance, bearing) into (distance / scale, sin bearing, cos bearing).

    A bearing jumps from pi to -pi behind the robot; its sine and cosine do not, and lie in [-1, 1].
    The scaled distance is of order one if ``scale`` is a typical distance. It is only divided,
    neither shifted nor clipped; to scale other observations, such as a lidar in metres, append a
    :class:`torchrl.envs.ObservationNorm`.

    In a replay buffer name the keys of both time steps, e.g. ``in_keys=["goal", ("next",
    "goal")]``.

    Args:
        in_keys (Sequence[NestedKey]): positions of shape ``[*B, 2]``: distance in metres, bearing
            in radians.
        out_keys (Sequence[NestedKey]): where to write the features, of shape ``[*B, 3]``.
        scale (float or Sequence[float]): the distance in metres that becomes 1, for all keys or one
            per key.

    Raises:
        ValueError: if the numbers of keys or scales differ, or if a scale is not finite and
            positive.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> goal = torch.tensor([[5.0, 0.0]])
        >>> features = PolarFeatures(["goal"], ["goal_features"], scale=10.0)
        >>> features(TensorDict(goal=goal, batch_size=[1]))["goal_features"]
        tensor([[0.5000, 0.0000, 1.0000]])

    """

    def __init__(
        self,
        in_keys: Sequence[NestedKey] = ("goal", "human"),
        out_keys: Sequence[NestedKey] = ("goal_features", "human_features"),
        scale: float | Sequence[float] = 1.0,
    ) -> None:
        in_keys, out_keys = key_list(in_keys), key_list(out_keys)
        if len(in_keys) != len(out_keys):
            raise ValueError(f"got {len(in_keys)} in_keys but {len(out_keys)} out_keys.")
        is_list = isinstance(scale, Sequence) and not isinstance(scale, str)
        scales = tuple(scale) if is_list else (scale,) * len(in_keys)
        if len(scales) != len(in_keys):
            raise ValueError(f"got {len(scales)} scales for {len(in_keys)} in_keys.")
        for key, value in zip(in_keys, scales):
            if not (isinstance(value, numbers.Real) and 0 < value < math.inf):
                raise ValueError(f"the scale of {key!r} must be finite and > 0, got {value!r}.")
        super().__init__(in_keys=in_keys, out_keys=out_keys)
        self.scales = tuple(float(value) for value in scales)

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        for in_key, out_key, scale in zip(self.in_keys, self.out_keys, self.scales):
            next_tensordict.set(out_key, polar_features(next_tensordict[in_key], scale))
        return next_tensordict

    @dispatch(source="in_keys", dest="out_keys", auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Add the features to a tensordict.

        Args:
            tensordict (TensorDictBase): holds the ``in_keys``.

        Returns:
            The same tensordict with the ``out_keys``; for a lazy stack, a shallow copy of it.

        """
        return self._call(apart_from_storage(tensordict))

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        # TorchRL does not run `_call` at reset.
        return self._call(tensordict_reset)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        observation_spec = observation_spec.clone()
        for in_key, out_key, scale in zip(self.in_keys, self.out_keys, self.scales):
            spec = observation_spec[in_key]
            observation_spec[out_key] = self._features_spec(spec, scale)
        return observation_spec

    def __repr__(self) -> str:
        return describe(self, in_keys=self.in_keys, out_keys=self.out_keys, scale=self.scales)

    def _features_spec(self, spec: Bounded | Unbounded, scale: float) -> Bounded | Unbounded:
        kwargs = {"device": spec.device, "dtype": spec.dtype}
        if isinstance(spec, Unbounded):
            return Unbounded((*spec.shape[:-1], 3), **kwargs)
        low, high = spec.space.low[..., 0] / scale, spec.space.high[..., 0] / scale
        one = torch.ones_like(low)
        return Bounded(
            torch.stack([low, -one, -one], -1), torch.stack([high, one, one], -1), **kwargs
        )
