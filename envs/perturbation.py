"""Faults of sensors and actuation."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor


@dataclasses.dataclass(frozen=True)
class Perturbation:
    """Sensor and actuation faults, for robust training and transfer checks; all off by default.

    Args:
        range_noise: standard deviation of each lidar range, metres.
        dropout: probability that a lidar ray reports no return.
        velocity_noise: standard deviation of the executed velocities, as a share of their range.
        latency: control steps (0 or 1) between a command and its execution.

    Raises:
        ValueError: for values outside these ranges.
    """

    range_noise: float = 0.0
    dropout: float = 0.0
    velocity_noise: float = 0.0
    latency: int = 0

    def __post_init__(self) -> None:
        if not (self.range_noise >= 0 and self.velocity_noise >= 0):
            raise ValueError(f"Noise must not be negative, got {self}.")
        if not 0 <= self.dropout <= 1:
            raise ValueError(f"dropout is a probability in [0, 1], got {self.dropout}.")
        if self.latency not in (0, 1):
            raise ValueError(f"latency must be 0 or 1 control steps, got {self.latency}.")

    def disturb_ranges(
        self, ranges: Tensor, max_range: float, generator: torch.Generator
    ) -> Tensor:
        """Lidar ranges with noise and lost returns; ``max_range`` (metres) is no return."""
        if self.range_noise:
            noise = torch.randn(ranges.shape, generator=generator, dtype=ranges.dtype)
            ranges = ranges + torch.where(ranges < max_range, self.range_noise * noise, 0.0)
        if self.dropout:
            lost = torch.rand(ranges.shape, generator=generator, dtype=ranges.dtype) < self.dropout
            ranges = ranges.masked_fill(lost, max_range)
        return ranges

    def disturb_velocity(
        self, velocity: Tensor, low: Tensor, high: Tensor, generator: torch.Generator
    ) -> Tensor:
        """Commanded velocities ``[*B, 2]`` with noise; their range is from ``low`` to ``high``."""
        if not self.velocity_noise:
            return velocity
        noise = torch.randn(velocity.shape, generator=generator, dtype=velocity.dtype)
        return velocity + self.velocity_noise * (high - low) * noise
