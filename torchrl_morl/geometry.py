"""Planar geometry, batched in torch: angles, rotations, and distances to oriented rectangles.

A rectangle ("box") is five numbers: centre x, centre y, yaw, half length, half width.
"""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["point_box_distance", "rotate", "wrap_angle"]


def rotate(vector: Tensor, angle: Tensor) -> Tensor:
    """Rotate planar vectors counter-clockwise.

    Args:
        vector: ``[*B, 2]``.
        angle: ``[*B]``, radians.

    Returns:
        ``[*B, 2]``.
    """
    cos, sin = angle.cos(), angle.sin()
    x, y = vector[..., 0], vector[..., 1]
    return torch.stack((cos * x - sin * y, sin * x + cos * y), dim=-1)


def wrap_angle(angle: Tensor) -> Tensor:
    """Map radians to (-pi, pi]."""
    wrapped = torch.remainder(angle + torch.pi, 2 * torch.pi) - torch.pi
    return torch.where(wrapped == -torch.pi, wrapped + 2 * torch.pi, wrapped)


def point_box_distance(point: Tensor, box: Tensor) -> Tensor:
    """Signed distance from points to the outline of boxes, negative inside.

    Args:
        point: ``[*B, 2]``, metres.
        box: ``[*B, 5]`` (x, y, yaw, half length, half width), broadcastable to ``point``.

    Returns:
        ``[*B]``, metres.

    Examples:
        >>> import torch
        >>> box = torch.tensor([0.0, 0.0, 0.0, 1.0, 0.5])
        >>> point_box_distance(torch.tensor([[3.0, 0.0], [0.0, 0.0]]), box)
        tensor([ 2.0000, -0.5000])
    """
    local = rotate(point - box[..., :2], -box[..., 2]).abs() - box[..., 3:]
    outside = local.clamp_min(0.0).norm(dim=-1)
    return outside + local.amax(dim=-1).clamp_max(0.0)
