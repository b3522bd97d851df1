"""The two drives of a robot: from poses and velocities to the simulator's coordinates, and back."""

from __future__ import annotations

import numpy as np

from .geometry import arctan2, cos_sin
from .mjcf import Drive


def pose_to_qpos(pose: np.ndarray, drive: Drive, nq: int) -> np.ndarray:
    """Coordinates ``[n, nq]`` of robots that stand at ``pose`` [n, 3] (metres, radians)."""
    if drive == "planar":
        return pose
    qpos = np.zeros((len(pose), nq))
    qpos[:, :2] = pose[:, :2]
    qpos[:, 3:7] = yaw_quaternion(pose[:, 2])
    return qpos


def qpos_to_pose(qpos: np.ndarray, drive: Drive) -> np.ndarray:
    """Pose (x, y, heading in (-pi, pi]) of every robot in ``qpos`` [n, nq], as a new array."""
    if drive == "planar":
        pose = qpos.copy()
    else:
        w, x, y, z = qpos[:, 3:7].T
        pose = np.empty((len(qpos), 3))
        pose[:, :2] = qpos[:, :2]
        pose[:, 2] = arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    yaw = np.remainder(pose[:, 2] + np.pi, 2 * np.pi) - np.pi
    yaw[yaw == -np.pi] += 2 * np.pi
    pose[:, 2] = yaw
    return pose


def velocity_to_ctrl(velocity: np.ndarray, drive: Drive) -> np.ndarray:
    """Controls ``[n, nu]`` for forward speed (m/s) and turn rate (rad/s) ``[n, 2]``."""
    if drive == "wheels":
        return velocity
    # The third servo keeps the base from slipping sideways.
    ctrl = np.zeros((len(velocity), 3))
    ctrl[:, :2] = velocity
    return ctrl


def yaw_quaternion(yaw: np.ndarray) -> np.ndarray:
    """Rotations about the vertical axis: radians ``[*B]`` -> ``[*B, 4]``."""
    quaternion = np.zeros((*yaw.shape, 4))
    quaternion[..., 0], quaternion[..., 3] = cos_sin(yaw / 2)
    return quaternion
