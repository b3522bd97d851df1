"""Pooling of range scans."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import dispatch
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs.transforms import ObservationTransform

from torchrl_morl.arguments import check_count, check_positive, key_list
from torchrl_morl.representation import describe
from torchrl_morl.transforms.stored import apart_from_storage

__all__ = ["LidarMinPool", "LogRange", "valid_ranges"]


@dataclasses.dataclass(frozen=True)
class LogRange:
    """Maps ranges in metres to ``log(range / max_range) / 3``."""

    max_range: float

    def __post_init__(self) -> None:
        check_positive("max_range", self.max_range)

    def __call__(self, ranges: Tensor) -> Tensor:
        """Ranges of any shape, at least a millimetre."""
        return (ranges / self.max_range).clamp_min(1e-3 / self.max_range).log() / 3

    def inverse(self, values: Tensor) -> Tensor:
        """Ranges in metres of what a call gave.

        Examples:
            >>> to_log = LogRange(4.0)
            >>> to_log.inverse(to_log(torch.tensor([0.25, 4.0])))
            tensor([0.2500, 4.0000])
        """
        return self.max_range * (3 * values).exp()


def valid_ranges(ranges: Tensor, range_min: float, range_max: float) -> Tensor:
    """Ranges between the limits, and NaN for those that are invalid: see :class:`LidarMinPool`.

    Args:
        ranges: of any shape, metres.
        range_min: nearest one that is valid.
        range_max: what is free reads so.
    """
    too_close = ranges == -math.inf
    invalid = ~too_close & ((ranges < range_min) | (ranges <= 0))
    ranges = ranges.clamp(range_min, range_max)  # NaN stays
    return ranges.masked_fill(invalid, torch.nan)


class LidarMinPool(ObservationTransform):
    """Keep the nearest return of every sector of a range scan.

    The rays of the last dimension are cut in equal, contiguous sectors, and each sector is reduced
    to its minimum: the closest obstacle is never averaged away. De Heuvel et al.
    (https://arxiv.org/abs/2404.04857) pool 720 rays to 30.

    Values keep their unit (metres); to scale them for a network append a
    :class:`torchrl.envs.ObservationNorm`. In a replay buffer name the keys of both time steps, e.g.
    ``in_keys=["scan", ("next", "scan")]``.

    A scan of a simulator is valid. That of a real lidar is not: say so with ``range_min`` or
    ``range_max``. A range that is NaN, not positive or below ``range_min`` is invalid and left out.
    Infinity and what is above ``range_max`` is free, as in ROS's `REP 117
    <https://www.ros.org/reps/rep-0117.html>`_, and reads ``range_max``; so does a sector without a
    valid ray. Minus infinity is an obstacle that is too close to be measured: it reads
    ``range_min``. For rays at other angles see :class:`torchrl_morl.deploy.LidarGeometry`.

    Args:
        num_sectors (int): the number of sectors, a divisor of the number of rays.
        in_keys (Sequence[NestedKey]): scans of shape ``[*B, num_rays]``.
        out_keys (Sequence[NestedKey]): where to write the pooled scans, of shape ``[*B,
            num_sectors]``.

    Keyword Args:
        range_min (float, optional): nearest range that is valid, metres.
        range_max (float, optional): furthest one. Both or neither must be given.

    Raises:
        ValueError: if there is less than one sector, if the numbers of keys differ, if the rays
            of a scan cannot be split evenly, or if the limits are not in ascending order.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> scan = torch.tensor([[4.0, 1.5, 3.0, 2.0]])
        >>> LidarMinPool(2)(TensorDict(scan=scan, batch_size=[1]))["lidar"]
        tensor([[1.5000, 2.0000]])
        >>> real = torch.tensor([[0.0, 1.5, torch.inf, torch.nan]])
        >>> pool = LidarMinPool(2, range_min=0.1, range_max=4.0)
        >>> pool(TensorDict(scan=real, batch_size=[1]))["lidar"]
        tensor([[1.5000, 4.0000]])

    """

    def __init__(
        self,
        num_sectors: int = 30,
        in_keys: Sequence[NestedKey] = ("scan",),
        out_keys: Sequence[NestedKey] = ("lidar",),
        *,
        range_min: float | None = None,
        range_max: float | None = None,
    ) -> None:
        check_count("num_sectors", num_sectors)
        in_keys, out_keys = key_list(in_keys), key_list(out_keys)
        if len(in_keys) != len(out_keys):
            raise ValueError(f"got {len(in_keys)} in_keys but {len(out_keys)} out_keys.")
        given = (range_min is not None, range_max is not None)
        if any(given) and not (all(given) and 0 <= range_min < range_max < math.inf):
            raise ValueError(
                "range_min and range_max must both be given, finite, not negative and in ascending "
                f"order, got {range_min} and {range_max}."
            )
        super().__init__(in_keys=in_keys, out_keys=out_keys)
        self.num_sectors = num_sectors
        self.range_min, self.range_max = range_min, range_max

    def _apply_transform(self, scan: Tensor) -> Tensor:
        num_rays = scan.shape[-1]
        if num_rays % self.num_sectors:
            raise ValueError(
                f"{num_rays} rays cannot be split in {self.num_sectors} equal sectors."
            )
        if self.range_min is not None:
            scan = valid_ranges(scan, self.range_min, self.range_max)
            scan = scan.masked_fill(scan.isnan(), self.range_max)
        return scan.unflatten(-1, (self.num_sectors, -1)).amin(-1)

    # The default of Transform guesses a batch size from the scan and then refuses a smaller lidar.
    @dispatch(source="in_keys", dest="out_keys", auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Add the pooled scans to a tensordict.

        Args:
            tensordict (TensorDictBase): holds the ``in_keys``.

        Returns:
            The same tensordict with the ``out_keys``; for a lazy stack, a shallow copy of it.

        """
        return self._call(apart_from_storage(tensordict))

    def __repr__(self) -> str:
        return describe(
            self,
            num_sectors=self.num_sectors,
            in_keys=self.in_keys,
            out_keys=self.out_keys,
            range_min=self.range_min,
            range_max=self.range_max,
        )

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        # TorchRL does not run `_call` at reset.
        return self._call(tensordict_reset)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        observation_spec = observation_spec.clone()
        for in_key, out_key in zip(self.in_keys, self.out_keys):
            spec = observation_spec[in_key]
            if self.range_min is not None:
                low = spec.space.low.new_zeros(*spec.shape[:-1], self.num_sectors)
                observation_spec[out_key] = Bounded(
                    low, low + self.range_max, device=spec.device, dtype=spec.dtype
                )
                continue
            # The minimum of a sector is at most every upper bound in it.
            low, high = (
                self._apply_transform(bound) for bound in (spec.space.low, spec.space.high)
            )
            if isinstance(spec, Unbounded):
                pooled = Unbounded(low.shape, device=spec.device, dtype=spec.dtype)
            else:
                pooled = Bounded(low, high, device=spec.device, dtype=spec.dtype)
            observation_spec[out_key] = pooled
        return observation_spec
