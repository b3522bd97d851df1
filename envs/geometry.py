"""Exact planar distances between points, segments and oriented rectangles, batched in torch.

What metrics of trajectories need as well is in :mod:`torchrl_morl.geometry`.

A rectangle ("box") is five numbers: centre x, centre y, yaw, half length, half width.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from torchrl_morl.geometry import point_box_distance, rotate, wrap_angle

__all__ = [
    "arctan2",
    "box_box_distance",
    "box_corners",
    "cos_sin",
    "norm",
    "point_box_distance",
    "rotate",
    "segment_box_distance",
    "wrap_angle",
]

_CORNER_SIGNS = torch.tensor([[1.0, 1.0], [1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0]])


def box_corners(box: Tensor) -> Tensor:
    """Corners of boxes ``[*B, 5]`` in order, ``[*B, 4, 2]``."""
    offsets = _CORNER_SIGNS.to(box) * box[..., None, 3:]
    return box[..., None, :2] + rotate(offsets, box[..., None, 2].expand(offsets.shape[:-1]))


def box_box_distance(first: Tensor, second: Tensor) -> Tensor:
    """Distance between boxes, zero where they overlap.

    Two disjoint convex polygons are nearest at a corner of one of them; whether they are
    disjoint is decided by the separating axis theorem (two boxes may cross without either
    containing a corner of the other).

    Args:
        first: ``[*B, 5]``.
        second: ``[*B, 5]``, broadcastable.

    Returns:
        ``[*B]``, metres.
    """
    first, second = torch.broadcast_tensors(first, second)
    corners_first, corners_second = box_corners(first), box_corners(second)
    nearest = torch.minimum(
        point_box_distance(corners_first, second[..., None, :]).amin(-1),
        point_box_distance(corners_second, first[..., None, :]).amin(-1),
    )
    yaw = torch.stack(
        (
            first[..., 2],
            first[..., 2] + torch.pi / 2,
            second[..., 2],
            second[..., 2] + torch.pi / 2,
        ),
        dim=-1,
    )
    axes = torch.stack((yaw.cos(), yaw.sin()), dim=-1)  # [*B, 4 axes, 2]
    shadow_first = torch.einsum("...cd,...ad->...ac", corners_first, axes)
    shadow_second = torch.einsum("...cd,...ad->...ac", corners_second, axes)
    gap = torch.maximum(
        shadow_first.amin(-1) - shadow_second.amax(-1),
        shadow_second.amin(-1) - shadow_first.amax(-1),
    )
    separated = (gap > 0).any(-1)
    return torch.where(separated, nearest, torch.zeros_like(nearest))


def segment_box_distance(start: Tensor, end: Tensor, box: Tensor) -> Tensor:
    """Distance between line segments and boxes, zero where they cross.

    Args:
        start: ``[*B, 2]``.
        end: ``[*B, 2]``.
        box: ``[*B, 5]``.

    Returns:
        ``[*B]``, metres.
    """
    # A segment is a box of zero width.
    delta = end - start
    flat = torch.zeros(*torch.broadcast_shapes(start.shape[:-1], end.shape[:-1]), 5).to(start)
    flat[..., :2] = (start + end) / 2
    flat[..., 2] = torch.atan2(delta[..., 1], delta[..., 0])
    flat[..., 3] = delta.norm(dim=-1) / 2
    return box_box_distance(flat, box)


# For the simulation, whose memory is NumPy's: on so few numbers it is several times faster than
# PyTorch. Angles are left to PyTorch all the same, which rounds their last bit differently: a seed
# should give the same episodes as before.


def arctan2(y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Angles of the points ``(x, y)``, radians."""
    y, x = (torch.from_numpy(np.ascontiguousarray(values)) for values in (y, x))
    return torch.atan2(y, x).numpy()


def cos_sin(angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cosines and sines of radians."""
    angle = torch.from_numpy(angle)
    return angle.cos().numpy(), angle.sin().numpy()


def norm(vector: np.ndarray) -> np.ndarray:
    """Lengths along the last dimension."""
    return np.sqrt(np.vecdot(vector, vector))
