"""The two drives of a robot: from poses and velocities to the simulator's coordinates, and back."""

from __future__ import annotations

import torch
from torch import Tensor

from .geometry import wrap_angle
from .mjcf import Drive
from .robots import Robot


def pose_to_qpos(pose: Tensor, drive: Drive, nq: int) -> Tensor:
    """Coordinates ``[n, nq]`` of robots that stand at ``pose`` [n, 3] (metres, radians)."""
    if drive == "planar":
        return pose
    qpos = pose.new_zeros(len(pose), nq)
    qpos[:, :2] = pose[:, :2]
    qpos[:, 3:7] = yaw_quaternion(pose[:, 2])
    return qpos


def qpos_to_pose(qpos: Tensor, drive: Drive) -> Tensor:
    """Pose (x, y, heading in (-pi, pi]) of every robot in ``qpos`` [n, nq]."""
    if drive == "planar":
        yaw = qpos[:, 2]
    else:
        w, x, y, z = qpos[:, 3:7].unbind(-1)
        yaw = torch.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return torch.cat((qpos[:, :2], wrap_angle(yaw)[:, None]), dim=-1)


def velocity_to_ctrl(velocity: Tensor, drive: Drive, robot: Robot) -> Tensor:
    """Controls ``[n, nu]`` for forward speed (m/s) and turn rate (rad/s) ``[n, 2]``."""
    if drive == "planar":
        # The third servo keeps the base from slipping sideways.
        return torch.nn.functional.pad(velocity, (0, 1))
    speed, turn = velocity.unbind(-1)
    half = robot.wheel_separation / 2
    wheels = torch.stack((speed - half * turn, speed + half * turn), dim=-1)
    return wheels / robot.wheel_radius


def yaw_quaternion(yaw: Tensor) -> Tensor:
    """Rotations about the vertical axis: radians ``[*B]`` -> ``[*B, 4]``."""
    zero = torch.zeros_like(yaw)
    return torch.stack(((yaw / 2).cos(), zero, zero, (yaw / 2).sin()), dim=-1)
