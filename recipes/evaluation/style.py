"""How much a policy drives like demonstrations, wherever they were driven: aligned at the human.

A recorded drive exists in its own scene alone. What can be compared elsewhere is how the human is
passed: on which side, at which distance, along which path. Paths are therefore moved and turned so that
the human is the origin and the way from the start to the goal points along x.
"""

from __future__ import annotations

import dataclasses
from typing import Literal

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_morl.evaluation import discrete_frechet
from torchrl_morl.geometry import rotate

WITHIN = 3.0
"""Metres around the human within which paths are compared."""

Side = Literal["left", "right"]


@dataclasses.dataclass(frozen=True)
class Drives:
    """Paths past a human who stands at the origin, the goal along x.

    Args:
        position: ``[N, T, 2]``, metres.
        mask: which points count, ``[N, T]``.
    """

    position: Tensor
    mask: Tensor

    def __len__(self) -> int:
        return len(self.position)

    @property
    def nearest(self) -> Tensor:
        """Smallest distance to the human, ``[N]``, metres."""
        return self._distance.amin(-1)

    @property
    def passes_left(self) -> Tensor:
        """Which pass on the left of the human, seen from the start: bool ``[N]``."""
        # Abreast of the human: on an orbit every point is as near.
        abreast = self.position[..., 0].abs().masked_fill(~self.mask, torch.inf).argmin(-1)
        return self.position[torch.arange(len(self)), abreast, 1] > 0

    @property
    def side(self) -> Side:
        """On which most pass."""
        return "left" if self.passes_left.float().mean() > 0.5 else "right"

    def on(self, side: Side) -> float:
        """Share that passes on a side."""
        left = self.passes_left.float().mean().item()
        return left if side == "left" else 1 - left

    @property
    def _distance(self) -> Tensor:
        return self.position.norm(dim=-1).masked_fill(~self.mask, torch.inf)

    def distance_to(self, shown: Drives) -> Tensor:
        """Frechet distance near the human to the most similar of the demonstrations, ``[N]``, metres.

        NaN for a drive that never comes near.
        """
        distance = discrete_frechet(
            self.position[:, None],
            (self.mask & (self._distance <= WITHIN))[:, None],
            shown.position.to(self.position)[None],
            (shown.mask & (shown._distance <= WITHIN))[None],
        )
        # Of demonstrations that never come near there is no distance either.
        smallest = distance.nan_to_num(torch.inf).amin(-1)
        return smallest.masked_fill(smallest.isinf(), torch.nan)


def aligned(position: Tensor, mask: Tensor, human: Tensor, goal: Tensor) -> Drives:
    """Paths as :class:`Drives`.

    Args:
        position: ``[N, T, 2]``, metres; the first point is the start.
        mask: ``[N, T]``.
        human: ``[N, 2]``, where they stand, or stood at the start.
        goal: ``[N, 2]``.

    Examples:
        >>> import torch
        >>> path = torch.tensor([[[0.0, 0.0], [2.0, 1.0], [4.0, 0.0]]])
        >>> human, goal = torch.tensor([[2.0, 0.0]]), torch.tensor([[4.0, 0.0]])
        >>> drives = aligned(path, torch.ones(1, 3).bool(), human, goal)
        >>> drives.side, drives.nearest
        ('left', tensor([1.]))
    """
    way = goal - position[:, 0]
    turn = -torch.atan2(way[:, 1], way[:, 0])
    moved = position - human[:, None]
    return Drives(rotate(moved, turn[:, None].expand(moved.shape[:-1])), mask)


def of_demonstrations(data: TensorDictBase) -> Drives:
    """Those of a file of demonstrations ``[N, T]``."""
    start, first = data["pose"][:, :1, :2], data[:, 0]
    position = torch.cat((start, data["next", "pose"][..., :2]), dim=1)
    mask = torch.cat((torch.ones_like(data["mask"][:, :1]), data["mask"]), dim=1)
    heading = first["pose"][:, 2] + first["goal"][:, 1]
    ahead = torch.stack((heading.cos(), heading.sin()), dim=-1)
    goal = first["pose"][:, :2] + first["goal"][:, :1] * ahead
    return aligned(position, mask, first["human_pose"][:, :2], goal.to(position))


def of_sweep(paths: TensorDict, scenes: TensorDictBase, preference: int) -> Drives:
    """Those of one preference of a :class:`~recipes.evaluation.sweep.Sweep`."""
    driven = paths[preference]
    return aligned(driven["position"], driven["mask"], scenes["human"][:, :2], scenes["goal"])
