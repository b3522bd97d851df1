"""Faults of sensors and actuation."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor


@dataclasses.dataclass(frozen=True)
class Faults:
    """Sensor and actuation faults, for robust training and transfer checks; all off by default.

    Each is a number, or a pair of numbers: a range from which every episode draws its own. One
    policy is so trained over all of them (domain randomisation, https://arxiv.org/abs/1703.06907).

    Args:
        range_noise: standard deviation of each lidar range, metres.
        dropout: probability that a lidar ray reports no return.
        velocity_noise: standard deviation of the executed velocities, as a share of their range.
        latency: control steps (0 or 1) between a command and its execution; of the pair (0, 1)
            both are as likely.

    Raises:
        ValueError: for values outside these ranges, or a pair that is not in ascending order.

    Examples:
        >>> faults = Faults(range_noise=(0.0, 0.05), latency=1)
        >>> amounts = faults.draw(1000, torch.Generator().manual_seed(0))
        >>> amounts.shape, bool((amounts[:, 0] <= 0.05).all()), bool((amounts[:, 3] == 1).all())
        (torch.Size([1000, 4]), True, True)
    """

    range_noise: float | tuple[float, float] = 0.0
    dropout: float | tuple[float, float] = 0.0
    velocity_noise: float | tuple[float, float] = 0.0
    latency: int | tuple[int, int] = 0

    def __post_init__(self) -> None:
        for name in (field.name for field in dataclasses.fields(self)):
            value = getattr(self, name)
            if isinstance(value, Sequence):  # of a configuration: a list
                object.__setattr__(self, name, tuple(value))
            ends = self._ends(name)
            numbers = all(isinstance(end, (int, float)) for end in ends)
            if len(ends) != 2 or not numbers or ends[0] > ends[1]:
                raise ValueError(
                    f"{name} must be a number or a pair in ascending order, got {value!r}."
                )
        if not all(end >= 0 for end in self._ends("range_noise") + self._ends("velocity_noise")):
            raise ValueError(f"Noise must not be negative, got {self}.")
        if not all(0 <= end <= 1 for end in self._ends("dropout")):
            raise ValueError(f"dropout is a probability in [0, 1], got {self.dropout}.")
        if not all(end in (0, 1) for end in self._ends("latency")):
            raise ValueError(f"latency must be 0 or 1 control steps, got {self.latency}.")

    def _ends(self, name: str) -> tuple[float, float]:
        value = getattr(self, name)
        return value if isinstance(value, tuple) else (value, value)

    @functools.cached_property
    def is_random(self) -> bool:
        """Whether episodes draw their faults."""
        return any(isinstance(value, tuple) for value in dataclasses.astuple(self))

    @functools.cached_property
    def disturb_scans(self) -> bool:
        """Whether lidar ranges can have noise or lose returns."""
        return bool(self.most["range_noise"] or self.most["dropout"])

    @functools.cached_property
    def most(self) -> dict[str, float]:
        """The largest amount of each fault that an episode can have."""
        return {field.name: self._ends(field.name)[1] for field in dataclasses.fields(self)}

    def draw(self, n: int, generator: torch.Generator) -> Tensor:
        """Amounts of the faults in ``n`` episodes, ``[n, 4]``, float64, in the order of the fields.

        Nothing is drawn from the generator if no fault is random.
        """
        ends = [self._ends(field.name) for field in dataclasses.fields(self)]
        low, high = torch.tensor(ends, dtype=torch.float64).T
        if not self.is_random:
            return low.repeat(n, 1)
        share = torch.rand(n, len(ends), generator=generator, dtype=torch.float64)
        share[:, 3] = (share[:, 3] < 0.5).double()
        return low + (high - low) * share

    def disturb_ranges(
        self, ranges: Tensor, amounts: Tensor, max_range: float, generator: torch.Generator
    ) -> Tensor:
        """Lidar ranges with noise and lost returns.

        Args:
            ranges: ``[n, rays]``, metres.
            amounts: of the faults in these environments, ``[n, 4]``, see :meth:`draw`.
            max_range: what no return reads, metres.
            generator: of the draws.
        """
        if self.most["range_noise"]:
            noise = torch.randn(ranges.shape, generator=generator, dtype=ranges.dtype)
            ranges = ranges + torch.where(ranges < max_range, amounts[:, 0:1] * noise, 0.0)
        if self.most["dropout"]:
            lost = torch.rand(ranges.shape, generator=generator, dtype=ranges.dtype)
            ranges = ranges.masked_fill(lost < amounts[:, 1:2], max_range)
        return ranges

    def disturb_velocity(
        self,
        velocity: Tensor,
        amounts: Tensor,
        low: Tensor,
        high: Tensor,
        generator: torch.Generator,
    ) -> Tensor:
        """Commanded velocities with noise.

        Args:
            velocity: ``[n, 2]``, m/s and rad/s.
            amounts: as above.
            low: end of their ranges, ``[2]``.
            high: the other end.
            generator: of the draws.
        """
        if not self.most["velocity_noise"]:
            return velocity
        noise = torch.randn(velocity.shape, generator=generator, dtype=velocity.dtype)
        return velocity + amounts[:, 2:3] * (high - low) * noise


def get_faults(faults: Faults | Mapping[str, Any] | None) -> Faults:
    """Return the faults, made from their mapping (a configuration) if need be; ``None`` has none.

    Raises:
        ValueError: for a fault that does not exist, or an amount that is refused.
    """
    if isinstance(faults, Faults):
        return faults
    known = [field.name for field in dataclasses.fields(Faults)]
    for name in faults or {}:
        if name not in known:
            raise ValueError(f"Unknown fault {name!r}: choose among {known}.")
    return Faults(**(faults or {}))
