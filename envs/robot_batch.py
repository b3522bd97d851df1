"""The robots of a batch of simulations: one for all, or one an episode."""

from __future__ import annotations

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch
from torch import Tensor

from torchrl_morl.arguments import check_count

from .mjcf import Drive
from .robot_ranges import DRIVEN, RobotRanges
from .robots import Robot

NUM_REPORTED = DRIVEN.index("lidar_offset") + 1
"""Numbers of a robot that a policy may be told, the first of :data:`envs.robot_ranges.DRIVEN`."""

_COLUMN = {name: index for index, name in enumerate(DRIVEN)}
_SERVOS = {"forward": "linear_response", "turn": "angular_response"}


class RobotBatch:
    """Sizes and limits of the robots.

    Args:
        robots: one, or ranges of which every episode draws.
        num_envs: ``N``.
        drive: of them.

    Raises:
        ValueError: for ranges and wheels, which do not change their size.
    """

    def __init__(self, robots: Robot | RobotRanges, num_envs: int, drive: Drive) -> None:
        check_count("num_envs", num_envs)
        self.varies = isinstance(robots, RobotRanges)
        self.ranges = robots if self.varies else None
        if self.varies and drive != "planar":
            raise ValueError(f"drive must be 'planar' for robots that differ, got {drive!r}.")
        self.largest = robots.largest if self.varies else robots
        speed, turn = (1.0, 1.0) if self.varies else self._limits(self.largest)
        bounds = torch.tensor([[0.0, -turn], [speed, turn]], dtype=torch.float64)
        self._bounds = bounds[0], bounds[1]
        row = [getattr(self.largest, name) for name in DRIVEN]
        self.numbers = np.tile(np.array(row, dtype=np.float64), (num_envs, 1))
        """``[N, 8]``, in the order of :data:`envs.robot_ranges.DRIVEN`."""

    @property
    def radius(self) -> float | np.ndarray:
        """Metres; ``[N]`` where they differ."""
        return self.numbers[:, 0].copy() if self.varies else self.largest.radius

    def differing(self, rows: np.ndarray | slice) -> np.ndarray | None:
        """Numbers of the robots ``[n, 8]`` where they differ."""
        return self.numbers[rows] if self.varies else None

    def snapshot(self, rows: np.ndarray | slice) -> dict[str, np.ndarray]:
        """What goes on from a snapshot needs of robots that differ."""
        return {"robot": self.numbers[rows].copy()} if self.varies else {}

    def report(self, rows: np.ndarray | slice) -> Tensor:
        """What a policy may be told, ``[n, 6]``."""
        return torch.from_numpy(self.numbers[rows, :NUM_REPORTED].copy())

    def action_bounds(self) -> tuple[Tensor, Tensor]:
        """Lowest and highest action ``[2]``: m/s and rad/s, or shares of the limits where they differ."""
        return self._bounds

    def velocity_bounds(self) -> tuple[Tensor, Tensor]:
        """Lowest and highest velocity, m/s and rad/s, ``[2]``, or ``[N, 2]`` where they differ."""
        if not self.varies:
            return self.action_bounds()
        high = torch.from_numpy(self.numbers[:, 1:3])
        return high * torch.tensor([0.0, -1.0], dtype=torch.float64), high

    def velocity(self, action: Tensor) -> Tensor:
        """What actions ``[N, 2]`` command, m/s and rad/s, before they are clamped."""
        return action * torch.from_numpy(self.numbers[:, 1:3]) if self.varies else action

    def open(self, batch: Batch, model: mujoco.MjModel) -> None:
        """Let the models of a batch differ."""
        if self.varies:
            self._fields = {
                name: batch.expand(name)
                for name in ("geom_size", "actuator_gainprm", "actuator_biasprm")
            }
            self._geom = model.geom("robot").id
            self._gains = {
                name: (model.actuator(name).id, float(model.actuator(name).gainprm[0]))
                for name in _SERVOS
            }

    def close(self) -> None:
        """Let go of the batch, for a copy of the environment."""
        self.__dict__.pop("_fields", None)

    def replace(self, rows: np.ndarray, numbers: np.ndarray) -> None:
        """Other robots ``[n, 8]`` in the environments ``rows``; ``set_const`` of the batch follows."""
        self.numbers[rows] = numbers
        self._fields["geom_size"][rows, self._geom, 0] = numbers[:, 0]
        for name, response in _SERVOS.items():
            servo, gain = self._gains[name]
            # A servo's gain is what it moves over its time constant.
            gains = gain * getattr(self.largest, response) / numbers[:, _COLUMN[response]]
            self._fields["actuator_gainprm"][rows, servo, 0] = gains
            self._fields["actuator_biasprm"][rows, servo, 2] = -gains

    @staticmethod
    def _limits(robot: Robot) -> tuple[float, float]:
        return robot.max_speed, robot.max_turn_rate
