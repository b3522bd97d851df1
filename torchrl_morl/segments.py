"""Partitions of the simplex of preferences, one cell for each group of environments."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from torchrl_morl.generators import rand
from torchrl_morl.preferences import PreferenceSpace, SamplingDistribution, check_distribution

__all__ = ["PreferenceSegments"]


@dataclass(frozen=True)
class PreferenceSegments:
    """A partition of the simplex in ``C_p`` cells of equal probability under Dirichlet(1).

    PD-MORL (https://arxiv.org/abs/2208.07914) gives every parallel environment its own part of the
    preference space, so that one batch always covers all of it. Its code cuts a sorted grid into
    slabs along the first objective, and so does ``slabs``; otherwise:

    - ``C_p = T``: cell ``i`` holds the preferences whose largest entry is the ``i``-th (ties: the
      first of them), i.e. those nearest to corner ``i``.
    - Otherwise: under Dirichlet(1) the sticks ``b_i = p_i / (1 - p_1 - ... - p_{i-1})`` are
      independent and Beta(1, T - i), so ``u_i = 1 - (1 - b_i)^(T - i)`` maps the simplex onto the
      unit cube of ``T - 1`` dimensions and keeps probability. The cube is cut recursively across
      the longest side of a box, in proportion to the cells that each part still has to hold, which
      gives ``C_p`` boxes of volume ``1 / C_p``. For ``T = 2`` these are intervals of the first
      entry.
    - ``T = 1``: the simplex is one point, which every segment is; its index is 0.

    Args:
        preference_space (PreferenceSpace): the space to cut.
        num_segments (int): the number ``C_p`` of cells, at least one.
        slabs (bool): cut along the first entry alone: it rises from cell to cell, and within a cell the
            others take any share of what is left.

    Raises:
        ValueError: if there is less than one segment.

    Example:
        >>> import torch
        >>> segments = PreferenceSegments(PreferenceSpace(("demo", "distance", "efficiency")), 3)
        >>> segments.index(torch.tensor([[0.8, 0.1, 0.1], [0.2, 0.3, 0.5]]))
        tensor([0, 2])
        >>> segments.index(segments.sample(torch.tensor([0, 1, 2, 0])))
        tensor([0, 1, 2, 0])

    """

    preference_space: PreferenceSpace
    num_segments: int
    slabs: bool = False

    def __post_init__(self) -> None:
        if self.num_segments < 1:
            raise ValueError(f"num_segments must be at least 1, got {self.num_segments}.")

    def index(self, preference: Tensor) -> Tensor:
        """The cell of each preference.

        Args:
            preference (Tensor): preferences of shape ``[*B, T]``.

        Returns:
            Indices in ``[0, C_p)`` of shape ``[*B]``, dtype long.

        """
        self.preference_space.check_shape(preference)
        if self._by_largest:
            return preference.argmax(-1)
        cube = _simplex_to_cube(preference.double()).unsqueeze(-2)
        lower, upper = self._boxes(preference.device)
        # Half-open boxes, closed at the far faces of the cube, make the cells disjoint and
        # exhaustive.
        inside = (cube >= lower) & ((cube < upper) | (upper == 1))
        return inside.all(-1).long().argmax(-1)

    def sample(
        self,
        segment_index: Tensor,
        distribution: SamplingDistribution = "dirichlet",
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """Draw one preference from each of the given cells.

        Args:
            segment_index (Tensor): cells in ``[0, C_p)``, of shape ``[*B]`` and dtype long.
            distribution (str): the one to condition on the cell, see :meth:`PreferenceSpace.sample`.
            generator (torch.Generator, optional): the source of randomness, on the device of
                ``segment_index``.

        Returns:
            Preferences of shape ``[*B, T]`` on the device of ``segment_index``.

        Raises:
            ValueError: if the distribution is unknown.

        """
        check_distribution(distribution)
        size = self.preference_space.num_tunable
        if size == 1 or self.num_segments == 1:
            return self.preference_space.sample(
                segment_index.shape, distribution, generator, segment_index.device
            )
        if self._by_largest:
            # All laws are exchangeable, so swapping the largest entry with the wanted one leaves
            # the distribution within the cell.
            drawn = self.preference_space.sample(
                segment_index.shape, distribution, generator, segment_index.device
            )
            wanted = segment_index.unsqueeze(-1)
            largest = drawn.argmax(-1, keepdim=True)
            swapped = drawn.scatter(-1, largest, drawn.gather(-1, wanted))
            return swapped.scatter(-1, wanted, drawn.gather(-1, largest))
        flat = segment_index.flatten()
        if distribution == "dirichlet":
            preference = self._sample_boxes(flat, generator).to(torch.get_default_dtype())
        else:
            preference = self._sample_rejecting(flat, distribution, generator)
        return preference.reshape(*segment_index.shape, size)

    def _sample_boxes(self, flat_index: Tensor, generator: torch.Generator | None) -> Tensor:
        lower, upper = self._boxes(flat_index.device)
        lower, upper = lower[flat_index], upper[flat_index]
        uniform = rand(lower.shape, generator, flat_index.device, torch.double)
        return _cube_to_simplex(lower + (upper - lower) * uniform)

    def _sample_rejecting(
        self,
        flat_index: Tensor,
        distribution: SamplingDistribution,
        generator: torch.Generator | None,
    ) -> Tensor:
        # Draw from the whole simplex until every row has hit its cell.
        preference = self.preference_space.sample(
            len(flat_index), distribution, generator, flat_index.device
        )
        pending = torch.arange(len(flat_index), device=flat_index.device)
        while True:
            pending = pending[self.index(preference[pending]) != flat_index[pending]]
            if not len(pending):
                return preference
            preference[pending] = self.preference_space.sample(
                len(pending), distribution, generator, flat_index.device
            )

    @property
    def _by_largest(self) -> bool:
        return self.num_segments == self.preference_space.num_tunable and not self.slabs

    def _boxes(self, device: torch.device) -> tuple[Tensor, Tensor]:
        cut = _equal_slabs if self.slabs else _equal_boxes
        boxes = torch.tensor(
            cut(self.preference_space.num_tunable - 1, self.num_segments),
            dtype=torch.double,
            device=device,
        ).reshape(self.num_segments, 2, -1)
        return boxes[:, 0], boxes[:, 1]


@lru_cache(maxsize=64)
def _equal_boxes(dim: int, count: int) -> tuple[tuple[tuple[float, ...], tuple[float, ...]], ...]:
    """Cut the unit cube into ``count`` boxes ``(lower, upper)`` of the same volume."""

    def cut(lower: tuple[float, ...], upper: tuple[float, ...], cells: int) -> list:
        if cells == 1 or not dim:
            return [(lower, upper)] * cells
        sides = [b - a for a, b in zip(lower, upper, strict=True)]
        axis = sides.index(max(sides))
        first = cells // 2
        middle = lower[axis] + sides[axis] * first / cells
        return [
            *cut(lower, (*upper[:axis], middle, *upper[axis + 1 :]), first),
            *cut((*lower[:axis], middle, *lower[axis + 1 :]), upper, cells - first),
        ]

    return tuple(cut((0.0,) * dim, (1.0,) * dim, count))


def _equal_slabs(dim: int, count: int) -> tuple[tuple[tuple[float, ...], tuple[float, ...]], ...]:
    """Cut the unit cube along its first side into ``count`` boxes ``(lower, upper)``."""
    rest = max(0, dim - 1)
    return tuple(
        ((cell / count, *(0.0,) * rest)[:dim], ((cell + 1) / count, *(1.0,) * rest)[:dim])
        for cell in range(count)
    )


def _powers(size: int, like: Tensor) -> Tensor:
    return torch.arange(size - 1, 0, -1, dtype=like.dtype, device=like.device)


def _simplex_to_cube(preference: Tensor) -> Tensor:
    # What is left of the stick before each piece, summed from the far end: no cancellation there.
    left = preference.flip(-1).cumsum(-1).flip(-1)
    kept = left[..., 1:] / left[..., :-1]
    # An exhausted stick has no next piece; any cell on that boundary would do, 0 is the first one.
    kept = torch.where(left[..., :-1] > 0, kept, torch.ones_like(kept))
    return (1 - kept.pow(_powers(preference.shape[-1], preference))).clamp(0, 1)


def _cube_to_simplex(cube: Tensor) -> Tensor:
    size = cube.shape[-1] + 1
    kept = (1 - cube).pow(1 / _powers(size, cube))
    before = torch.cat([torch.ones_like(kept[..., :1]), kept.cumprod(-1)], -1)
    return torch.cat([before[..., :-1] * (1 - kept), before[..., -1:]], -1)
