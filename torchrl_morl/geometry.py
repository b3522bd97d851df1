"""Planar geometry, batched in torch: angles, rotations, and exact distances between points, segments
and oriented rectangles.

A rectangle ("box") is five numbers: centre x, centre y, yaw, half length, half width.
"""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = [
    "box_box_distance",
    "box_corners",
    "cartesian",
    "point_box_distance",
    "rotate",
    "segment_box_distance",
    "wrap_angle",
]

_CORNER_SIGNS = torch.tensor([[1.0, 1.0], [1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0]])


def cartesian(polar: Tensor) -> Tensor:
    """Ahead and to the left, from distance and bearing.

    Args:
        polar: ``[*B, 2]``, metres and radians.

    Returns:
        ``[*B, 2]``, metres.

    Example:
        >>> cartesian(torch.tensor([2.0, torch.pi / 2])).round(decimals=3)
        tensor([-0., 2.])
    """
    distance, bearing = polar.unbind(-1)
    return torch.stack((distance * bearing.cos(), distance * bearing.sin()), dim=-1)


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
