"""Distance between paths, batched over padded trajectories."""

from __future__ import annotations

import torch
from torch import Tensor

from .arrays import as_flags, as_points

__all__ = ["discrete_frechet", "resample_path"]


def discrete_frechet(path_a: Tensor, mask_a: Tensor, path_b: Tensor, mask_b: Tensor) -> Tensor:
    r"""Discrete Frechet distance between two paths, metres.

    The shortest leash with which a man on one path and a dog on the other, both jumping from point to
    point and never back, get from start to end (Eiter and Mannila, Computing Discrete Frechet
    Distance, 1994). With :math:`d_{ij} = |a_i - b_j|`,

    .. math::
        c_{ij} = \max(d_{ij}, \min(c_{i-1,j}, c_{i-1,j-1}, c_{i,j-1})).

    All pairs of the batch advance together, one anti-diagonal of this table at a time. Points are
    what counts: against the distance between the curves it errs by up to the longest step. Use
    :func:`resample_path` first where paths are sampled differently.

    Args:
        path_a: ``[*B, T, 2]``, metres. Any number of coordinates will do.
        mask_a: ``[*B, T]``, the points that count. Padding may hold anything, also NaN.
        path_b: ``[*B, S, 2]``; its batch is broadcast with that of ``path_a``.
        mask_b: ``[*B, S]``.

    Returns:
        ``[*B]``; NaN where a path has no points.

    Examples:
        >>> import torch
        >>> line = torch.tensor([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]])
        >>> mask = torch.ones(3, dtype=torch.bool)
        >>> discrete_frechet(line, mask, line + torch.tensor([0.0, 0.5]), mask)
        tensor(0.5000)
        >>> discrete_frechet(line, mask, line.flip(0), mask)
        tensor(2.)

    """
    path_a, num_a = _compact(as_points("path_a", path_a), mask_a)
    path_b, num_b = _compact(as_points("path_b", path_b), mask_b)
    batch = torch.broadcast_shapes(num_a.shape, num_b.shape)
    path_a = path_a.expand(*batch, -1, -1)
    path_b = path_b.expand(*batch, -1, -1)
    num_a, num_b = num_a.expand(batch), num_b.expand(batch)
    size_a, size_b = path_a.shape[-2], path_b.shape[-2]
    row = torch.arange(size_a, device=path_a.device)
    result = path_a.new_full(batch, torch.nan)
    # Diagonal k holds the cells (i, k - i) at index i + 1. Index 0 lies outside of the table, where
    # there is no way to come from, except into the first cell.
    last = path_a.new_full((*batch, size_a + 1), torch.inf)
    second_last = last.clone()
    second_last[..., 0] = 0
    for k in range(size_a + size_b - 1):
        column = k - row
        inside = (column >= 0) & (column < size_b)
        opposite = path_b[..., column.clamp(0, size_b - 1), :]
        distance = torch.linalg.vector_norm(path_a - opposite, dim=-1)
        reach = torch.minimum(torch.minimum(last[..., :-1], last[..., 1:]), second_last[..., :-1])
        cell = torch.maximum(distance, reach).masked_fill(~inside, torch.inf)
        # An empty path would end outside of the table.
        at_end = inside & (row == num_a.unsqueeze(-1) - 1) & (column == num_b.unsqueeze(-1) - 1)
        result = torch.where(at_end.any(-1), cell.masked_fill(~at_end, 0).sum(-1), result)
        second_last, last = last, torch.cat([torch.full_like(last[..., :1], torch.inf), cell], -1)
    return result


def resample_path(position: Tensor, mask: Tensor, num_points: int) -> Tensor:
    """Points at equal distances along a path.

    Linear interpolation by arc length, from the first to the last point: where the robot went,
    without when.

    Args:
        position: ``[*B, T, 2]``, metres.
        mask: ``[*B, T]``, the points that count.
        num_points: at least 2.

    Returns:
        ``[*B, num_points, 2]``. All points are the same for a robot that never moved; NaN where a
        path has no points.

    Raises:
        ValueError: for less than two points.

    Examples:
        >>> import torch
        >>> path = torch.tensor([[0.0, 0.0], [0.1, 0.0], [1.0, 0.0], [1.0, 1.0]])
        >>> resample_path(path, torch.ones(4, dtype=torch.bool), 5)[:, 0]
        tensor([0.0000, 0.5000, 1.0000, 1.0000, 1.0000])

    """
    if num_points < 2:
        raise ValueError(f"num_points must be at least 2, got {num_points}.")
    position, _ = _compact(as_points("position", position), mask)
    # One more copy of the end, so that even a single point makes a segment.
    position = torch.cat([position, position[..., -1:, :]], -2)
    step = torch.linalg.vector_norm(position.diff(dim=-2), dim=-1)
    along = torch.cat([torch.zeros_like(step[..., :1]), step.cumsum(-1)], -1)
    share = torch.linspace(0, 1, num_points, dtype=position.dtype, device=position.device)
    wanted = (along[..., -1:] * share).contiguous()
    after = torch.searchsorted(along, wanted).clamp(1, position.shape[-2] - 1)
    before = after - 1
    start, end = along.gather(-1, before), along.gather(-1, after)
    # Points that coincide have no length to divide by.
    length = (end - start).masked_fill(end == start, 1)
    fraction = ((wanted - start) / length).clamp(0, 1).unsqueeze(-1)
    return torch.lerp(_take(position, before), _take(position, after), fraction)


def _compact(position: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
    """Move the points that count to the front and repeat the last of them; NaN if there is none.

    Returns the points ``[*B, T, 2]`` and their number ``[*B]``.
    """
    mask = as_flags(mask)
    count = mask.sum(-1)
    order = mask.long().argsort(dim=-1, descending=True, stable=True)
    slot = torch.arange(mask.shape[-1], device=mask.device).expand(mask.shape)
    slot = torch.minimum(slot, (count - 1).clamp(min=0).unsqueeze(-1))
    points = _take(position, order.gather(-1, slot))
    return points.masked_fill((count == 0)[..., None, None], torch.nan), count


def _take(position: Tensor, index: Tensor) -> Tensor:
    index = index.unsqueeze(-1).expand(*index.shape, position.shape[-1])
    return position.gather(-2, index)
