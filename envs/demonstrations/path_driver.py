"""Drives along a given path, in closed loop: what was shown once is shown again, under any noise."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torch.nn import functional as F

from torchrl_morl.geometry import wrap_angle

from ..robot_ranges import RobotRanges, get_robots, largest
from ..robots import TURTLEBOT2, Robot
from .drivers import Driver

PROGRESS = "path_step"
"""Where the drivers note how far each robot has come."""


class PathDriver(Driver):
    """Pure pursuit of a path whose points are one control period apart (Coulter, CMU-RI-TR-92-01).

    The robot aims at the point of its path that lies ``lookahead`` metres ahead of the nearest one,
    at the speed at which that part of the path was driven; behind its end, straight on. Unlike a
    driver that replays commands it comes back to the path when something pushes it away.

    How far a robot has come, the index of its nearest point, goes from step to step in the tensordict
    as ``path_step`` ``[N]``; without that entry it is at the start.

    Args:
        path: of each robot, metres in the world, ``[N, L, 2]``.
        mask: which points are valid, ``[N, L]``: true up to the end of a path, then false.
        robot: whose limits it respects.

    Keyword Args:
        lookahead: metres. A longer one is smoother, and rounds corners by about a third of it.
        period: between two points of a path, seconds.
        pose_key: x, y (m) and heading (rad) of the robots in the world, ``[N, 3]``.
        action_key: where the action ``[N, 2]`` is written.
        scaled: in [-1, 1] instead of m/s and rad/s.

    Raises:
        ValueError: for paths and masks that do not fit, a path with fewer than two points, or a
            lookahead that is not positive.

    Examples:
        >>> import torch
        >>> from envs import NavigationEnv
        >>> env = NavigationEnv(scene="empty", num_envs=2, seed=0)
        >>> start = env.reset()["pose"]
        >>> ahead = torch.linspace(0, 2, 21)[:, None]
        >>> way = torch.stack((start[:, 2].cos(), start[:, 2].sin()), -1)
        >>> path = start[:, None, :2] + ahead * way[:, None]
        >>> driver = PathDriver(path, torch.ones(2, 21, dtype=torch.bool))
        >>> action = driver(env.reset().set("pose", start))["action"]
        >>> action.shape
        torch.Size([2, 2])
    """

    _WINDOW = 10
    """Points ahead among which the nearest is looked for: a path may come back to where it was."""

    _LEAST_SPEED = 0.05
    """Metres a second: who stood still while showing does not keep this driver for ever."""

    def __init__(
        self,
        path: Tensor,
        mask: Tensor,
        robot: str | Robot | RobotRanges = TURTLEBOT2,
        *,
        lookahead: float = 0.2,
        period: float = 0.2,
        pose_key: NestedKey = "pose",
        action_key: NestedKey = "action",
        scaled: bool = False,
    ) -> None:
        if path.ndim != 3 or path.shape[-1] != 2 or mask.shape != path.shape[:-1]:
            raise ValueError(
                "path must have the shape [N, L, 2] and mask [N, L], got "
                f"{tuple(path.shape)} and {tuple(mask.shape)}."
            )
        points = mask.sum(-1)
        if (points < 2).any():
            raise ValueError("a path must have at least two points: some have fewer.")
        if not lookahead > 0:
            raise ValueError(f"lookahead must be positive, got {lookahead} m.")
        fastest = largest(get_robots(robot)).max_speed
        super().__init__(fastest, robot, [pose_key], action_key, scaled)
        self.lookahead = lookahead
        rows = torch.arange(len(path), device=path.device)
        self._last = points - 1
        index = torch.arange(path.shape[1], device=path.device).minimum(self._last.unsqueeze(-1))
        # Behind its end a path stays where it ends.
        self.path = path[rows.unsqueeze(-1), index].float()
        step = (self.path[:, 1:] - self.path[:, :-1]).norm(dim=-1)
        self._arc = F.pad(step.cumsum(-1), (1, 0))
        # The speed over about a second: single steps are as noisy as the recording.
        speed = F.avg_pool1d(
            F.pad(step, (2, 2), mode="replicate").unsqueeze(1), 5, stride=1
        ).squeeze(1)
        speed = F.pad(speed / period, (0, 1), mode="replicate")
        at_end = speed[rows, (self._last - 3).clamp_min(0)].unsqueeze(-1)
        beyond = torch.arange(speed.shape[1], device=path.device) > (self._last - 3).unsqueeze(-1)
        self._speed = torch.where(beyond, at_end, speed).clamp(self._LEAST_SPEED, self.max_speed)
        before = self.path[rows, (self._last - 3).clamp_min(0)]
        self._onwards = F.normalize(self.path[rows, self._last] - before, dim=-1)
        self.out_keys = [*self.out_keys, PROGRESS]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action for every robot."""
        pose = tensordict.get(self.in_keys[0]).to(self.path)
        rows = torch.arange(len(self.path), device=self.path.device)
        begun = tensordict.get(PROGRESS, None)
        at = torch.zeros_like(self._last) if begun is None else begun
        near = at.unsqueeze(-1) + torch.arange(self._WINDOW, device=at.device)
        near = near.minimum(self._last.unsqueeze(-1))
        off = (self.path[rows.unsqueeze(-1), near] - pose[:, None, :2]).norm(dim=-1)
        at = near[rows, off.argmin(-1)]
        arc = self._arc[rows, at] + self.lookahead
        index = torch.searchsorted(self._arc, arc.unsqueeze(-1)).squeeze(-1)
        target = self.path[rows, index.minimum(self._last)]
        beyond = (arc - self._arc[:, -1]).clamp_min(0.0)
        target = target + beyond.unsqueeze(-1) * self._onwards
        x, y = (target - pose[:, :2]).unbind(-1)
        bearing = wrap_angle(torch.atan2(y, x) - pose[:, 2])
        forward = self._speed[rows, at] * bearing.cos().clamp_min(0.0) ** 2
        tensordict.set(PROGRESS, at)
        return self._write(tensordict, forward, self._GAIN * bearing)
