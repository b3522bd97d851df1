"""Pairs of equally long snippets from trajectories of ranked quality."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from typing import Self

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_morl.arguments import check_seed
from torchrl_morl.representation import describe

__all__ = ["RankedSnippets"]


class RankedSnippets:
    r"""Draw pairs of snippets, one from a better and one from a worse group of trajectories.

    D-REX (https://arxiv.org/abs/1907.03976) rolls a cloned policy out with more and more noise; the
    groups are then the levels of noise, and minus the level is their quality. Snippets of a pair
    have the same number of steps, since a reward that is summed over unequal lengths learns that
    long is good, or bad. Feed the pairs to :class:`~torchrl_morl.objectives.BradleyTerryLoss`.

    A pair is drawn in three steps: two groups whose qualities are at least ``min_gap`` apart, all
    such combinations being equally likely; a trajectory of each; and, independently, where each
    snippet starts. (D-REX starts the preferred one no earlier than the other one, which teaches a
    reward how far the task is done, not in what style.)

    Trajectories with fewer than ``length`` valid steps are left out; ``num_left_out`` says how many.

    Args:
        groups (sequence of (float, TensorDictBase)): the quality of each group, higher is better, and
            its trajectories of shape ``[N, T]``. Groups may differ in N and T.

    Keyword Args:
        length (int): the number ``L`` of steps in a snippet.
        min_gap (float): the least difference in quality within a pair. Groups of the same quality
            are never compared.
        in_keys (Sequence[NestedKey]): what a snippet holds, the inputs of the reward model.
        mask_key (NestedKey): valid steps ``[N, T]`` or ``[N, T, 1]``, bool: true up to the end of the
            trajectory. All steps are valid in a group without it.
        focus_key (NestedKey, optional): steps ``[N, T]`` or ``[N, T, 1]``, bool, at which snippets
            start, such as those within 2 m of the human. A snippet of a trajectory without one starts
            anywhere.
        seed (int, optional): the seed of ``generator``. Without one it is drawn from the global
            generator of torch.

    Attributes:
        generator (torch.Generator): the source of all draws, on the device of the data.
        num_left_out (int): the number of trajectories that are too short.

    Raises:
        ValueError: for unknown or inconsistent options, a mask with holes, or if no pair is left.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> def rollouts():
        ...     data = {"observation": torch.randn(5, 40, 3), "action": torch.randn(5, 40, 2)}
        ...     return TensorDict(data, batch_size=[5, 40])
        >>> groups = [(-noise, rollouts()) for noise in (0.0, 0.1, 0.2)]
        >>> snippets = RankedSnippets(groups, length=30, min_gap=0.1, seed=0)
        >>> train, held_out = snippets.split(0.2)
        >>> pairs = train.sample(16)
        >>> pairs["preferred", "action"].shape, pairs["gap"].shape
        (torch.Size([16, 30, 2]), torch.Size([16]))

    """

    def __init__(
        self,
        groups: Sequence[tuple[float, TensorDictBase]],
        *,
        length: int,
        min_gap: float = 0.0,
        in_keys: Sequence[NestedKey] = ("observation", "action"),
        mask_key: NestedKey = "mask",
        focus_key: NestedKey | None = None,
        seed: int | None = None,
    ) -> None:
        if length < 1:
            raise ValueError(f"length must be at least 1, got {length}.")
        if not 0 <= min_gap < math.inf:
            raise ValueError(f"min_gap must be finite and >= 0, got {min_gap}.")
        sizes = [len(data) for _, data in groups]
        if len(sizes) < 2:
            raise ValueError(f"a ranking needs at least two groups, got {len(sizes)}.")
        self.length, self.min_gap, self.focus_key = length, min_gap, focus_key
        trajectories = [data for _, data in groups]
        longest = max(data.shape[1] for data in trajectories)
        mask = torch.cat([_flags(data, mask_key, longest, True) for data in trajectories])
        if (mask[:, 1:] & ~mask[:, :-1]).any():
            raise ValueError(
                f"{mask_key!r} must be true up to the end of a trajectory, then false."
            )
        device = mask.device
        self._quality = torch.tensor([q for q, _ in groups], dtype=torch.double, device=device)
        # Trajectories lie one after the other in the order of the groups: number them through.
        self._steps = torch.cat([data.select(*in_keys).reshape(-1) for data in trajectories])
        per_group = torch.tensor(sizes, device=device)
        self._group = torch.arange(len(sizes), device=device).repeat_interleave(per_group)
        stride = torch.tensor([data.shape[1] for data in trajectories], device=device)[self._group]
        self._offset = stride.cumsum(0) - stride
        # The steps at which a snippet can start, [trajectories, T].
        num_starts = (mask.sum(-1, keepdim=True) - length + 1).clamp(min=0)
        self._starts = torch.arange(longest, device=device) < num_starts
        if focus_key is not None:
            focus = torch.cat([_flags(data, focus_key, longest) for data in trajectories])
            focus = self._starts & focus
            self._starts = torch.where(focus.any(-1, keepdim=True), focus, self._starts)
        usable = num_starts.squeeze(-1) > 0
        self.num_left_out = int((~usable).sum())
        self._reseed(seed)
        self._index(usable)

    def __repr__(self) -> str:
        groups = {
            float(quality): int((self._usable & (self._group == group)).sum())
            for group, quality in enumerate(self._quality)
        }
        return describe(
            self,
            trajectories_of_quality=groups,
            length=self.length,
            min_gap=self.min_gap,
            focus_key=self.focus_key,
            seed=self.generator.initial_seed(),
        )

    def sample(self, batch_size: int) -> TensorDict:
        """Draw pairs, with replacement.

        Args:
            batch_size (int): the number ``B`` of pairs.

        Returns:
            A tensordict of shape ``[B]`` with the snippets ``preferred`` and ``other`` of shape
            ``[B, L]`` and ``gap`` ``[B]``, by how much the preferred one is better.

        """
        combination = self._randint(torch.tensor(len(self._gap)), batch_size)
        sides = []
        for members in (self._better, self._worse):
            row = self._randint(members.count[combination], batch_size)
            sides.append(members.get(combination, row))
        better, worse = sides
        # A draw more than is needed, and the other side's first: a seed gives the pairs it always gave.
        torch.rand(batch_size, 1, generator=self.generator, device=better.device)
        other = self._gather(worse)
        return TensorDict(
            {
                "preferred": self._gather(better),
                "other": other,
                "gap": self._gap[combination],
            },
            batch_size=[batch_size],
        )

    def split(self, fraction: float) -> tuple[Self, Self]:
        """Part the trajectories, so that a held-out snippet shares no step with the others.

        Args:
            fraction (float): the share of every group that is held out, in (0, 1), rounded to whole
                trajectories but at least one; the own generator decides which.

        Returns:
            The training part and the held-out part, which share the data but have generators of
            their own.

        Raises:
            ValueError: if the fraction is not within (0, 1) or a part has no pairs left.

        """
        if not 0 < fraction < 1:
            raise ValueError(f"fraction must be between 0 and 1, got {fraction}.")
        generator, device = self.generator, self._group.device
        held_out = torch.zeros_like(self._usable)
        for group in range(len(self._quality)):
            members = (self._usable & (self._group == group)).nonzero().squeeze(-1)
            order = torch.randperm(len(members), generator=generator, device=device)
            held_out[members[order[: max(1, round(fraction * len(members)))]]] = True
        parts = []
        for chosen in (~held_out, held_out):
            part = copy.copy(self)
            seed = torch.randint(2**62, (), generator=generator, device=device)
            part._reseed(int(seed))
            part._index(self._usable & chosen)
            parts.append(part)
        return parts[0], parts[1]

    def _reseed(self, seed: int | None) -> None:
        self.generator = torch.Generator(self._group.device)
        check_seed(seed)
        self.generator.manual_seed(int(torch.randint(2**62, ())) if seed is None else seed)

    def _index(self, usable: Tensor) -> None:
        """List what pairs can be drawn from: a few rows per combination of two groups."""
        self._usable = usable
        members = [
            (usable & (self._group == group)).nonzero().squeeze(-1)
            for group in range(len(self._quality))
        ]
        gaps, better, worse = [], [], []
        for i, first in enumerate(members):
            for j, second in enumerate(members):
                gap = float(self._quality[i] - self._quality[j])
                # Rounding: 0.3 - 0.1 is less than 0.2.
                if gap <= 0 or gap < self.min_gap - 1e-9:
                    continue
                if len(first) and len(second):
                    gaps.append(gap)
                    better.append(first)
                    worse.append(second)
        if not gaps:
            raise ValueError(
                f"no two groups at least {self.min_gap} apart have trajectories of {self.length} "
                f"steps: {int(usable.sum())} of {len(usable)} trajectories are long enough."
            )
        device = self._group.device
        self._gap = torch.tensor(gaps, device=device)
        self._better, self._worse = _Ragged(better), _Ragged(worse)

    def _randint(self, high: Tensor, size: int) -> Tensor:
        """Integers ``[B]`` in [0, high), where ``high`` may differ between entries."""
        uniform = torch.rand(
            size, dtype=torch.double, generator=self.generator, device=self._group.device
        )
        return (uniform * high.to(uniform.device)).long()

    def _gather(self, trajectory: Tensor) -> TensorDictBase:
        start = torch.multinomial(self._starts[trajectory].float(), 1, generator=self.generator)
        step = torch.arange(self.length, device=start.device)
        return self._steps[self._offset[trajectory].unsqueeze(-1) + start + step]


class _Ragged:
    """Rows of different length, one after the other."""

    def __init__(self, rows: Sequence[Tensor]) -> None:
        self.values = torch.cat(list(rows))
        self.count = torch.tensor([len(row) for row in rows], device=self.values.device)
        self.first = self.count.cumsum(0) - self.count

    def get(self, row: Tensor, column: Tensor) -> Tensor:
        return self.values[self.first[row] + column]


def _flags(
    data: TensorDictBase, key: NestedKey, longest: int, default: bool | None = None
) -> Tensor:
    """A boolean key as ``[N, longest]``, false behind the end."""
    value = data.get(key, None)
    if value is None:
        if default is None:
            raise KeyError(f"{key!r} is not in the trajectories, which hold {list(data.keys())}.")
        device = next(iter(data.values(True, True))).device
        value = torch.full(data.shape, default, device=device)
    value = value.reshape(data.shape)
    return torch.nn.functional.pad(value, (0, longest - data.shape[1]))
