"""A dynamic-window planner: what a robot drives that has no learning, no map and no style."""

from __future__ import annotations

import math

import torch
from tensordict import TensorDictBase
from torch import Tensor

from envs import NavigationEnv
from envs.demonstrations import Driver
from envs.lidar import MIN_RANGE
from envs.perception import NOBODY
from envs.robots import TURTLEBOT2, Robot, get_robot
from envs.scenes import HUMAN_RADIUS
from torchrl_morl.deploy import Sensing
from torchrl_morl.geometry import cartesian, rotate
from torchrl_morl.transforms.lidar import valid_ranges

_PERIOD = NavigationEnv.CONTROL_PERIOD

# Faster than anyone moves here: another episode has begun, or another person is the nearest.
_JUMP = 2.0

# Returns so near to the reported human are the human's, metres.
_OF_HUMAN = 0.15

_NO_RETURN = 100.0
"""Metres."""

_GOAL = 0.2
"""Distance at which an arc has reached the goal, metres."""

_AIM = round(1.0 / _PERIOD) - 1
"""The pose of an arc after a second."""

_ENOUGH = 0.5
"""Clearance that is as good as more, metres."""

_HEADING, _CLEARANCE, _VELOCITY = 2.0, 0.5, 1.0
"""Weights of the terms."""

_HORIZON = 3.0
"""How far ahead arcs are driven, seconds."""

_SHARPEST = 1.6
"""Of the turn rates that are tried, rad/s."""

_RAYS = 4
"""Side by side, of which the shortest counts."""


class DwaPlanner(Driver):
    """The dynamic-window approach of Fox, Burgard, and Thrun (1997), among people who walk.

    Each step it drives one of many arcs, speed and turn rate held: among those that touch nothing in
    time, the one of the best mean of heading, clearance and speed, the three terms of the paper. The
    base reaches any of its velocities within a step, so that its window is all of them. The reported
    human goes on as it has moved since the last report; every other return of the lidar stands.

    It has no path beyond its arcs, so that it can stop for good in a pocket. It sees what policies see,
    faults included, and its own odometry: ``scan`` ``[N, R]``, polar ``goal`` and ``human`` ``[N, 2]``,
    ``pose`` ``[N, 3]``. Where the human was, and whether one was reported, travels under ``dwa``
    ``[N, 3]``.

    Reference: "The Dynamic Window Approach to Collision Avoidance", IEEE Robotics & Automation Magazine
    4 (1), 1997.

    Args:
        speed: preferred speed, m/s; slower robots drive their own.
        robot: whose size and limits it respects.

    Keyword Args:
        margin: kept from everything, beyond the robot's radius, metres.
        scaled: write the action in [-1, 1] instead of in m/s and rad/s.

    Raises:
        ValueError: for a negative margin, or a speed that is not positive.

    Examples:
        >>> from envs.policy_env import make_policy_env
        >>> env = make_policy_env(scene="empty", num_envs=2, seed=0, keep_simulation=True)
        >>> env.rollout(300, DwaPlanner(scaled=True), break_when_any_done=False)[
        ...     "next", "success"
        ... ].any(1).all().item()
        True
    """

    def __init__(
        self,
        speed: float = 0.5,
        robot: str | Robot = TURTLEBOT2,
        *,
        margin: float = 0.05,
        scaled: bool = False,
    ) -> None:
        robot = get_robot(robot)
        in_keys = ["scan", "goal", "human", "pose"]
        super().__init__(min(speed, robot.max_speed), robot, in_keys, "action", scaled)
        self.out_keys = ["action", "dwa"]
        if margin < 0:
            raise ValueError(f"margin must not be negative, got {margin} m.")
        self.radius, self.lidar_offset = robot.radius + margin, robot.lidar_offset
        # Turn rates lie close together where it drives ahead.
        turns = min(self.max_turn_rate, _SHARPEST) * torch.linspace(-1.0, 1.0, 15) ** 3
        self.candidates = torch.cartesian_prod(torch.linspace(0.0, self.speed, 6), turns)
        # Poses on every arc, in the frame of the robot now: a turn about a centre beside it.
        self.times = _PERIOD * torch.arange(1, round(_HORIZON / _PERIOD) + 1)
        forward, turn = self.candidates[:, :1], self.candidates[:, 1:]
        angle = turn * self.times
        chord = forward * self.times * torch.sinc(angle / (2 * math.pi))
        self.ends = cartesian(torch.stack((chord, angle / 2), dim=-1))
        self.angles = angle[:, _AIM]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action of every robot ``[N]``."""
        scan, goal, human, pose = (tensordict.get(key).float() for key in self.in_keys)
        there = (human != human.new_tensor(NOBODY)).any(-1)
        where = cartesian(human)
        velocity, seen = self._velocity(where, there, pose, tensordict.get("dwa", None))
        tensordict.set("dwa", seen)

        # Every pose of every arc against everything: [N, C, T, ...].
        returns = self._returns(scan, where, there)
        gaps = torch.cdist(self.ends.flatten(0, 1), returns).amin(-1) - self.radius
        gaps = gaps.unflatten(-1, self.ends.shape[:2])
        people = where[:, None] + velocity[:, None] * self.times[:, None]
        apart = (self.ends - people[:, None]).norm(dim=-1) - self.radius - HUMAN_RADIUS
        gaps = torch.minimum(gaps, torch.where(there[:, None, None], apart, _NO_RETURN))

        # An arc is over at the goal; else it is to face the goal after a second.
        left = (cartesian(goal)[:, None, None] - self.ends).norm(dim=-1)
        arrived = (left < _GOAL).cummax(-1).values
        gaps = gaps.masked_fill(arrived, _NO_RETURN)
        nearest = gaps.amin(-1)
        towards = cartesian(goal)[:, None] - self.ends[:, _AIM]
        off = torch.atan2(towards[..., 1], towards[..., 0]) - self.angles
        facing = ((1 + off.cos()) / 2).masked_fill(arrived[..., -1], 1.0)
        score = (
            _HEADING * facing
            + _CLEARANCE * nearest.clamp(0.0, _ENOUGH)
            + _VELOCITY * self.candidates[:, 0] / self.speed
        )
        # Where every arc touches something, the one that does so last.
        touches = gaps <= 0
        first = torch.where(touches.any(-1), touches.int().argmax(-1), touches.shape[-1])
        score = torch.where(touches.any(-1), 0.01 * first + nearest - 10.0, score)
        forward, turn = self.candidates[score.argmax(-1)].unbind(-1)
        dtype = tensordict.get(self.in_keys[0]).dtype
        return self._write(tensordict, forward.to(dtype), turn.to(dtype))

    @staticmethod
    def _velocity(
        where: Tensor, there: Tensor, pose: Tensor, before: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """How the human moves, seen from the robot, ``[N, 2]``, m/s; and what to remember, ``[N, 3]``."""
        heading = pose[:, 2]
        world = pose[:, :2] + rotate(where, heading)
        seen = torch.cat((world, there[:, None]), dim=-1)
        if before is None:
            return torch.zeros_like(where), seen
        moved = (world - before[:, :2]) / _PERIOD
        known = there & before[:, 2].bool() & (moved.norm(dim=-1) <= _JUMP)
        return torch.where(known[:, None], rotate(moved, -heading), 0.0), seen

    def _returns(self, scan: Tensor, where: Tensor, there: Tensor) -> Tensor:
        """Where the lidar sees what is not the human, ``[N, P, 2]``, metres, from the robot."""
        # An invalid ray says nothing.
        scan = valid_ranges(scan, MIN_RANGE, Sensing.max_range).nan_to_num(_NO_RETURN)
        angle = torch.arange(scan.shape[-1]) * (2 * math.pi / scan.shape[-1])
        points = cartesian(torch.stack((scan, angle.expand_as(scan)), dim=-1))
        points[..., 0] += self.lidar_offset
        human = there[:, None] & ((points - where[:, None]).norm(dim=-1) < HUMAN_RADIUS + _OF_HUMAN)
        free = human | (scan >= Sensing.max_range)
        points = torch.where(free[..., None], _NO_RETURN, points)
        groups = points.unflatten(1, (-1, _RAYS))
        nearest = torch.where(free, _NO_RETURN, scan).unflatten(1, (-1, _RAYS)).argmin(-1)
        return groups.take_along_dim(nearest[..., None, None], dim=2).squeeze(2)
