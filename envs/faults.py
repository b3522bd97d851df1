"""Faults of sensors and actuation."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from .fields import shown

_NEVER_NEGATIVE = (
    "range_noise",
    "velocity_noise",
    "lag",
    "goal_drift",
    "human_noise",
    "human_bias",
)
_SHARES = ("dropout", "invalid_beams", "human_lost")
_MOST_LATENCY = 3
_PHASES = 4
"""Numbers in [0, 1) of an episode: how beams are coded, and which way everything lies or drifts."""
_CODING, _BLIND, _GOAL, _HUMAN = range(_PHASES)

_DRIFT_PERIOD = 30.0
"""Seconds in which a drifting goal goes round once."""


@dataclasses.dataclass(frozen=True)
class Faults:
    """Sensor and actuation faults, for robust training and transfer checks; all off by default.

    Each is a number, or a pair of numbers: a range from which every episode draws its own. One
    policy is so trained over all of them (domain randomisation, https://arxiv.org/abs/1703.06907).

    Args:
        range_noise: standard deviation of each lidar range, metres.
        dropout: probability that a lidar ray reports no return.
        velocity_noise: standard deviation of the executed velocities, as a share of their range.
        latency: control steps (0 to 3) between a command and its execution; of a pair all are as
            likely.
        invalid_beams: probability that a ray is invalid. Each episode codes that in its own way, as NaN,
            0, infinity or the longest range: see :class:`~torchrl_morl.transforms.LidarMinPool`.
        unknown_angle: part of the view, radians, whose rays are all invalid; it lies elsewhere in every
            episode.
        speed_scale: executed over commanded forward speed.
        turn_scale: the same for the turn rate.
        lag: time constant with which both follow a command, seconds, beyond the robot's own.
        goal_drift: how far the reported goal strays, metres; it circles the true one in 30 s.
        human_noise: standard deviation of each coordinate of the reported human, metres.
        human_bias: how far all reports of an episode are off to one side, metres.
        human_lost: share of the time in which nobody is reported, a second at once.

    Raises:
        ValueError: for values outside these ranges, or a pair that is not in ascending order.

    Examples:
        >>> faults = Faults(range_noise=(0.0, 0.05), latency=1)
        >>> amounts = faults.draw(1000, torch.Generator().manual_seed(0))
        >>> bool((amounts[:, 0] <= 0.05).all()), bool((amounts[:, 3] == 1).all())
        (True, True)
    """

    range_noise: float | tuple[float, float] = 0.0
    dropout: float | tuple[float, float] = 0.0
    velocity_noise: float | tuple[float, float] = 0.0
    latency: int | tuple[int, int] = 0
    invalid_beams: float | tuple[float, float] = 0.0
    unknown_angle: float | tuple[float, float] = 0.0
    speed_scale: float | tuple[float, float] = 1.0
    turn_scale: float | tuple[float, float] = 1.0
    lag: float | tuple[float, float] = 0.0
    goal_drift: float | tuple[float, float] = 0.0
    human_noise: float | tuple[float, float] = 0.0
    human_bias: float | tuple[float, float] = 0.0
    human_lost: float | tuple[float, float] = 0.0

    def __post_init__(self) -> None:
        for name in _COLUMNS:
            value = getattr(self, name)
            if isinstance(value, Sequence):  # of a configuration: a list
                object.__setattr__(self, name, tuple(value))
            ends = self._ends(name)
            numbers = all(isinstance(end, (int, float)) for end in ends)
            if len(ends) != 2 or not numbers or not ends[0] <= ends[1]:
                raise ValueError(
                    f"{name} must be a number or a pair in ascending order, got {value!r}."
                )
        for name in _NEVER_NEGATIVE:
            if not all(0 <= end < math.inf for end in self._ends(name)):
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}.")
        for name in _SHARES:
            if not all(0 <= end <= 1 for end in self._ends(name)):
                kind = "share of the time" if name == "human_lost" else "probability"
                raise ValueError(f"{name} is a {kind} in [0, 1], got {getattr(self, name)}.")
        if not all(0 <= end <= 2 * math.pi for end in self._ends("unknown_angle")):
            raise ValueError(
                f"unknown_angle must be from 0 to 6.283 radians, got {self.unknown_angle}."
            )
        for name in ("speed_scale", "turn_scale"):
            if not all(0 < end <= 2 for end in self._ends(name)):
                raise ValueError(
                    f"{name} must be above 0 and at most 2, got {getattr(self, name)}."
                )
        if not all(end in range(_MOST_LATENCY + 1) for end in self._ends("latency")):
            raise ValueError(
                f"latency must be 0 to {_MOST_LATENCY} control steps, got {self.latency}."
            )

    def _ends(self, name: str) -> tuple[float, float]:
        value = getattr(self, name)
        return value if isinstance(value, tuple) else (value, value)

    @functools.cached_property
    def is_random(self) -> bool:
        """Whether episodes draw something of their own."""
        return self._directed or any(isinstance(getattr(self, name), tuple) for name in _COLUMNS)

    @functools.cached_property
    def _directed(self) -> bool:
        """Whether an episode needs directions."""
        names = ("goal_drift", "human_bias", "human_lost")
        return self.code_beams or any(self.most[name] for name in names)

    @functools.cached_property
    def code_beams(self) -> bool:
        """Whether rays can be invalid, so that scans need a transform that knows it."""
        return bool(self.most["invalid_beams"] or self.most["unknown_angle"])

    @functools.cached_property
    def disturb_scans(self) -> bool:
        """Whether lidar ranges can have noise, lose returns or be invalid."""
        return bool(self.most["range_noise"] or self.most["dropout"] or self.code_beams)

    @functools.cached_property
    def misreport_human(self) -> bool:
        """Whether the human is reported elsewhere than they are, or not at all."""
        return any(self.most[name] for name in ("human_noise", "human_bias", "human_lost"))

    @functools.cached_property
    def misreport(self) -> bool:
        """Whether goal or human can be reported elsewhere than they are."""
        return bool(self.most["goal_drift"]) or self.misreport_human

    @functools.cached_property
    def scale(self) -> bool:
        """Whether the base drives other velocities than it is told."""
        return self._ends("speed_scale") != (1, 1) or self._ends("turn_scale") != (1, 1)

    @functools.cached_property
    def memory(self) -> int:
        """Commands that are remembered: those that are late, and the one that lags."""
        return int(self.most["latency"]) + bool(self.most["lag"])

    @functools.cached_property
    def most(self) -> dict[str, float]:
        """The largest amount of each fault that an episode can have."""
        return {name: self._ends(name)[1] for name in _COLUMNS}

    def draw(self, n: int, generator: torch.Generator) -> Tensor:
        """Amounts of the faults in ``n`` episodes, ``[n, NUM_AMOUNTS]``, float64, in the order of the
        fields; behind them four numbers in [0, 1), by which their directions are told.

        Nothing is drawn from the generator if no fault is random.
        """
        ends = [self._ends(name) for name in _COLUMNS]
        low, high = torch.tensor(ends, dtype=torch.float64).T
        if not self.is_random:
            return torch.cat((low, low.new_zeros(_PHASES))).repeat(n, 1)
        # The first four apart: a seed gives them what it gave before there were others.
        share = torch.rand(n, 4, generator=generator, dtype=torch.float64)
        rest = torch.zeros(n, NUM_AMOUNTS - 4, dtype=torch.float64)
        if any(isinstance(getattr(self, name), tuple) for name in _COLUMNS[4:]) or self._directed:
            rest = torch.rand(rest.shape, generator=generator, dtype=torch.float64)
        share = torch.cat((share, rest), dim=-1)
        phases = share[:, len(ends) :]
        amounts = low + (high - low) * share[:, : len(ends)]
        least, most = self._ends("latency")
        amounts[:, 3] = most - (share[:, 3] * (most - least + 1)).floor()
        return torch.cat((amounts, phases), dim=-1)

    def disturb_ranges(
        self, ranges: Tensor, amounts: Tensor, max_range: float, generator: torch.Generator
    ) -> Tensor:
        """Lidar ranges with noise and lost returns.

        Args:
            ranges: ``[n, rays]``, metres.
            amounts: of the faults in these environments, see :meth:`draw`.
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

    def code_invalid(
        self, scan: Tensor, amounts: Tensor, max_range: float, generator: torch.Generator
    ) -> Tensor:
        """Whole scans ``[n, rays]`` some of whose rays are invalid, each episode's in its coding."""
        if not self.code_beams:
            return scan
        phases = amounts[:, len(_COLUMNS) :]
        rays = torch.arange(scan.shape[-1], dtype=torch.float64) / scan.shape[-1]
        lost = torch.rand(scan.shape, generator=generator, dtype=torch.float64) < amounts[:, 4:5]
        off = (rays - phases[:, _BLIND, None] + 0.5).remainder(1.0) - 0.5
        lost |= off.abs() < amounts[:, 5:6] / (4 * math.pi)
        codes = torch.tensor([math.nan, 0.0, math.inf, max_range], dtype=scan.dtype)
        code = codes[(phases[:, _CODING] * len(codes)).long()]
        return torch.where(lost, code[:, None], scan)

    def goal_offset(self, amounts: Tensor, time: Tensor) -> Tensor:
        """From the true to the reported goal, ``[n, 2]``, metres, at ``time`` [n] seconds."""
        angle = 2 * math.pi * (amounts[:, len(_COLUMNS) + _GOAL] + time / _DRIFT_PERIOD)
        return amounts[:, 9:10] * torch.stack((angle.cos(), angle.sin()), dim=-1)

    def human_offset(self, amounts: Tensor, generator: torch.Generator) -> Tensor:
        """From the true to the reported human, ``[n, 2]``, metres."""
        noise = torch.randn(len(amounts), 2, generator=generator, dtype=torch.float64)
        angle = 2 * math.pi * amounts[:, len(_COLUMNS) + _HUMAN]
        side = torch.stack((angle.cos(), angle.sin()), dim=-1)
        return amounts[:, 10:11] * noise + amounts[:, 11:12] * side

    def loses_human(self, amounts: Tensor, time: Tensor) -> Tensor:
        """Whether nobody is reported at ``time`` [n] seconds, bool ``[n]``: a second at once."""
        # A draw that needs no memory: the fraction of a large sine, as in shaders.
        second = time.floor() + 1
        phase = amounts[:, len(_COLUMNS) + _HUMAN]
        draw = ((second * 12.9898 + phase * 78.233).sin() * 43758.5453).remainder(1.0)
        return draw < amounts[:, 12]

    def executed(self, command: Tensor, memory: Tensor, amounts: Tensor, period: float) -> Tensor:
        """What the base is told now: late, lagging, and scaled.

        Args:
            command: of the policy, ``[n, 2]``, m/s and rad/s.
            memory: of earlier ones, ``[n, memory, 2]``; it is changed in place.
            amounts: as above.
            period: of a control step, seconds.
        """
        late = int(self.most["latency"])
        if late:
            queue = torch.cat((command[:, None], memory[:, :late]), dim=1)
            memory[:, :late] = queue[:, :late].clone()
            command = queue[torch.arange(len(queue)), amounts[:, 3].long()]
        if self.most["lag"]:
            share = 1 - (-period / amounts[:, 8:9].clamp_min(1e-9)).exp()
            command = memory[:, late] + share * (command - memory[:, late])
            memory[:, late] = command.clone()
        return command * amounts[:, 6:8] if self.scale else command

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


_COLUMNS = tuple(field.name for field in dataclasses.fields(Faults))

NUM_AMOUNTS = len(_COLUMNS) + _PHASES
"""Of an episode: see :meth:`Faults.draw`."""


def get_faults(faults: Faults | Mapping[str, Any] | None) -> Faults:
    """Return the faults, made from their mapping (a configuration) if need be; ``None`` has none.

    Raises:
        ValueError: for a fault that does not exist, or an amount that is refused.
    """
    if isinstance(faults, Faults):
        return faults
    if not isinstance(faults, (Mapping, type(None))):
        raise ValueError(f"faults must be an envs.Faults or a mapping, got {shown(faults)}.")
    for name in faults or {}:
        if name not in _COLUMNS:
            raise ValueError(f"Unknown fault {shown(name)}: choose among {list(_COLUMNS)}.")
    return Faults(**(faults or {}))
