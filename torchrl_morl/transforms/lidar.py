"""Pooling of range scans."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from tensordict import TensorDictBase
from tensordict.nn import dispatch
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs.transforms import ObservationTransform

__all__ = ["LidarMinPool", "LogRange"]


@dataclasses.dataclass(frozen=True)
class LogRange:
    """Maps ranges in metres to ``log(range / max_range) / 3``."""

    max_range: float

    def __call__(self, ranges: Tensor) -> Tensor:
        """Ranges of any shape, at least a millimetre."""
        return (ranges / self.max_range).clamp_min(1e-3 / self.max_range).log() / 3


class LidarMinPool(ObservationTransform):
    """Keep the nearest return of every sector of a range scan.

    The rays of the last dimension are cut in equal, contiguous sectors, and each sector is reduced
    to its minimum: the closest obstacle is never averaged away. De Heuvel et al.
    (https://arxiv.org/abs/2404.04857) pool 720 rays to 30.

    Values keep their unit (metres); to scale them for a network append a
    :class:`torchrl.envs.ObservationNorm`. In a replay buffer name the keys of both time steps, e.g.
    ``in_keys=["scan", ("next", "scan")]``.

    Args:
        num_sectors (int): the number of sectors, a divisor of the number of rays.
        in_keys (Sequence[NestedKey]): scans of shape ``[*B, num_rays]``.
        out_keys (Sequence[NestedKey]): where to write the pooled scans, of shape ``[*B,
            num_sectors]``.

    Raises:
        ValueError: if there is less than one sector, if the numbers of keys differ, or if the rays
            of a scan cannot be split evenly.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> scan = torch.tensor([[4.0, 1.5, 3.0, 2.0]])
        >>> LidarMinPool(2)(TensorDict(scan=scan, batch_size=[1]))["lidar"]
        tensor([[1.5000, 2.0000]])

    """

    def __init__(
        self,
        num_sectors: int = 30,
        in_keys: Sequence[NestedKey] = ("scan",),
        out_keys: Sequence[NestedKey] = ("lidar",),
    ) -> None:
        if num_sectors < 1:
            raise ValueError(f"num_sectors must be at least 1, got {num_sectors}.")
        if len(in_keys) != len(out_keys):
            raise ValueError(f"got {len(in_keys)} in_keys but {len(out_keys)} out_keys.")
        super().__init__(in_keys=list(in_keys), out_keys=list(out_keys))
        self.num_sectors = num_sectors

    def _apply_transform(self, scan: Tensor) -> Tensor:
        num_rays = scan.shape[-1]
        if num_rays % self.num_sectors:
            raise ValueError(
                f"{num_rays} rays cannot be split in {self.num_sectors} equal sectors."
            )
        return scan.unflatten(-1, (self.num_sectors, -1)).amin(-1)

    # The default of Transform guesses a batch size from the scan and then refuses a smaller lidar.
    @dispatch(source="in_keys", dest="out_keys", auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Add the pooled scans to a tensordict.

        Args:
            tensordict (TensorDictBase): holds the ``in_keys``.

        Returns:
            The same tensordict with the ``out_keys``.

        """
        return self._call(tensordict)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        # TorchRL does not run `_call` at reset.
        return self._call(tensordict_reset)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        observation_spec = observation_spec.clone()
        for in_key, out_key in zip(self.in_keys, self.out_keys):
            spec = observation_spec[in_key]
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
