"""A policy as one function of tensors: from raw ranges to a command, for what traces and exports."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn

from torchrl_morl.transforms.robot import IsNobody

from .features import observation
from .lidar import SECTOR_EDGE, LidarGeometry, sector_of
from .policy import Policy
from .sensing import NUM_MOTION, Limits, Sensing

__all__ = ["PolicyGraph", "SectorMinima"]


class SectorMinima(nn.Module):
    """:meth:`LidarGeometry.sectors` in operations that can be traced.

    Args:
        lidar: of the robot.
        sensing: of the policy.

    Example:
        >>> import torch
        >>> lidar = LidarGeometry(0.0, math.pi / 2, 4, range_min=0.1, range_max=8.0)
        >>> sectors = SectorMinima(lidar, Sensing(num_sectors=4, unknown_range=3.5))
        >>> sectors(torch.tensor([[1.0, torch.nan, torch.inf, 0.0]]))
        tensor([[1.0000, 3.5000, 4.0000, 3.5000]], dtype=torch.float64)
    """

    def __init__(self, lidar: LidarGeometry, sensing: Sensing) -> None:
        super().__init__()
        self.num_sectors = sensing.num_sectors
        self.near, self.far = lidar.thresholds
        self.range_min = float(lidar.range_min)
        self.max_range, self.unknown_range = sensing.max_range, sensing.unknown_range
        x, y, _ = lidar.mount
        self.ahead, self.left = x - sensing.lidar_origin[0], y - sensing.lidar_origin[1]
        self.centred = math.hypot(self.ahead, self.left) < 1e-9
        if self.centred:
            self.register_buffer("beams", _beams_of_sectors(lidar, sensing.num_sectors))
            return
        angles = torch.from_numpy(lidar.angles)
        self.register_buffer("cos", angles.cos())
        self.register_buffer("sin", angles.sin())
        starts = torch.arange(self.num_sectors, dtype=torch.float64) - SECTOR_EDGE
        starts = (starts * (2 * math.pi / self.num_sectors)).unsqueeze(-1)
        self.register_buffer("start_cos", starts.cos())
        self.register_buffer("start_sin", starts.sin())

    def forward(self, ranges: Tensor) -> Tensor:
        """Shortest range of each sector, ``[B, num_sectors]``, float64, metres.

        Args:
            ranges: ``[B, num_beams]``, metres, as a driver reports them.
        """
        # The comparisons of the runner, which are those of float64.
        ranges = ranges.double()
        too_close = ranges == -math.inf
        free = ranges >= self.far
        valid = ((ranges >= self.near) & (ranges > 0)) | too_close
        length = torch.where(too_close, self.range_min, torch.where(free, self.max_range, ranges))
        if self.centred:
            length = length.clamp_max(self.max_range)
            length = torch.where(valid, length, math.inf)
            # Beside the beams one that sees nothing, for sectors that have fewer than others.
            length = torch.nn.functional.pad(length, (0, 1), value=math.inf)
            minima = length[:, self.beams.flatten()].unflatten(-1, self.beams.shape).amin(-1)
        else:
            minima = self._seen_from_origin(length, free, valid)
        return torch.where(minima.isinf(), self.unknown_range, minima)

    def _seen_from_origin(self, length: Tensor, free: Tensor, valid: Tensor) -> Tensor:
        x, y = self.ahead + length * self.cos, self.left + length * self.sin
        distance = (x.square() + y.square()).sqrt().clamp_max(self.max_range)
        distance = torch.where(free, self.max_range, distance)
        distance = torch.where(valid, distance, math.inf).unsqueeze(-2)
        if self.num_sectors == 1:  # it starts where it ends
            return distance.amin(-1)
        # At the origin itself there is no direction; atan2 says straight ahead.
        x = torch.where((x == 0) & (y == 0), 1.0, x).unsqueeze(-2)
        y = y.unsqueeze(-2)
        # To the left of where a sector starts, and to the right of where the next one does. This is the
        # sign of a cross product, exact where an arc tangent is not: ONNX Runtime has none in float64.
        left = self.start_cos * y - self.start_sin * x >= 0
        inside = left & ~left.roll(-1, -2)
        return torch.where(inside, distance, math.inf).amin(-1)


def _beams_of_sectors(lidar: LidarGeometry, num_sectors: int) -> Tensor:
    """Indices of the beams of each sector, ``[num_sectors, M]``; ``num_beams`` stands for none."""
    sector = sector_of(lidar.angles, num_sectors).astype(np.int64) % num_sectors
    members = [np.flatnonzero(sector == index) for index in range(num_sectors)]
    most = max(len(beams) for beams in members)
    table = np.full((num_sectors, most), lidar.num_beams)
    for row, beams in zip(table, members):
        row[: len(beams)] = beams
    return torch.from_numpy(table)


class PolicyGraph(nn.Module):
    """A policy and a lidar: what :class:`PolicyRunner` computes, without what it refuses.

    Distances are clamped, sectors without a valid beam read as unknown, and nothing is checked.

    Args:
        policy: from :func:`load_policy`.
        lidar: of the robot.

    Keyword Args:
        robot: which one it is, for policies that read it: see :meth:`LidarGeometry.robot`.

    Raises:
        ValueError: for a policy that does not tell what it senses, a lidar too coarse for it, or a robot
            that :meth:`LidarGeometry.robot` refuses.

    Example:
        >>> import torch
        >>> from torchrl_morl.testing import untrained_policy
        >>> lidar = LidarGeometry(0.0, math.pi / 180, 360, range_min=0.1, range_max=8.0)
        >>> graph = PolicyGraph(untrained_policy(), lidar)
        >>> graph.input_names
        ('ranges', 'goal', 'human', 'preference')
        >>> goal, preference = torch.tensor([[5.0, 0.3]]), torch.tensor([[0.2, 0.3, 0.5]])
        >>> graph(torch.full((1, 360), torch.inf), goal, human=goal, preference=preference).shape
        torch.Size([1, 2])
    """

    def __init__(
        self, policy: Policy, lidar: LidarGeometry, *, robot: Sequence[float] | None = None
    ) -> None:
        super().__init__()
        if policy.sensing is None:
            raise ValueError("the file of this policy does not tell what it senses.")
        lidar.check(policy.sensing)
        self.sensing, self.limits = policy.sensing, policy.limits
        robot = lidar.robot(self.sensing, robot)
        if robot is not None:
            # Of such a policy, ranges are those of the lidar where it is, and limits those of the robot.
            self.sensing = self.sensing.of_robot(robot)
            self.limits = Limits.of_robot(*robot[1:3])
        self.sectors = SectorMinima(lidar, self.sensing)
        # The layers alone: the check of preferences branches on values.
        self.layers = nn.Sequential(*policy.actor[0].module)
        self.dtype = next(policy.actor.parameters()).dtype
        low, high = torch.tensor((self.limits.speed, self.limits.turn_rate), dtype=self.dtype).T
        self.register_buffer(
            "robot", None if robot is None else torch.tensor(robot, dtype=self.dtype)
        )
        self.register_buffer("middle", (high + low) / 2)
        self.register_buffer("half_range", (high - low) / 2)
        reads = policy.sensing
        self.input_sizes = {
            "ranges": lidar.num_beams,
            "goal": 2,
            **({"human": 2} if reads.observe_human else {}),
            **({"human_velocity": 2} if reads.observe_human_velocity else {}),
            **({"motion": NUM_MOTION} if reads.observe_motion else {}),
            "preference": policy.preference_space.num_tunable,
        }
        self.input_names = tuple(self.input_sizes)

    def forward(
        self,
        ranges: Tensor,
        goal: Tensor,
        human: Tensor | None = None,
        human_velocity: Tensor | None = None,
        motion: Tensor | None = None,
        *,
        preference: Tensor,
    ) -> Tensor:
        """Speed (m/s) and turn rate (rad/s), ``[B, 2]``.

        Args:
            ranges: of the scan, ``[B, num_beams]``, metres.
            goal: distance (m) and bearing (rad), ``[B, 2]``.
            human: the same of the human, ``[B, 2]``, for policies that read it; nobody is
                ``sensing.nobody``.
            human_velocity: over the ground, ahead and to the left, ``[B, 2]``, m/s, likewise.
            motion: measured speed (m/s) and turn rate (rad/s), and those of the last four commands, the
                latest first, ``[B, 10]``, for policies that read it.
            preference: ``[B, T]``, on the simplex.
        """
        features = observation(
            self.sensing,
            lidar=self.sectors(ranges).to(self.dtype),
            goal=_clamped(goal, self.sensing.goal_range[1]),
            human=None if human is None else _clamped(human, self.sensing.human_range[1]),
            human_velocity=human_velocity,
            nobody=IsNobody(*self.sensing.nobody)(human) if self.sensing.observe_nobody else None,
            robot=None if self.robot is None else self.robot.expand(goal.shape[0], -1),
            motion=motion,
        )
        action = self.layers(torch.cat([features, preference], dim=-1)).tanh()
        return self.middle + self.half_range * action


def _clamped(position: Tensor, furthest: float) -> Tensor:
    """A position with a distance that is at most the furthest of the training."""
    distance, bearing = position.unbind(-1)
    return torch.stack([distance.clamp_max(furthest), bearing], -1)
