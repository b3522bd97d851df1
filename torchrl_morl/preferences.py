"""Preferences over objectives: names, weights, sampling, segments, test grids and validation.

:class:`PreferenceSpace` is the one place that knows which entries of a vector reward a user may
weigh. A *preference* is a point of the simplex over the ``T`` tunable objectives; the *weights*
are the vector over all ``K`` objectives, with the static weights filled in.
"""

from __future__ import annotations

import math
import numbers
import reprlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from math import comb
from typing import Literal, get_args

import torch
from torch import Tensor

from torchrl_morl.arguments import check_count, shown
from torchrl_morl.generators import randn

__all__ = [
    "PreferenceSpace",
    "SamplingDistribution",
    "check_distribution",
    "check_preference_space",
]

_MOST_PREFERENCES = 10_000_000

SamplingDistribution = Literal["dirichlet", "abs_normal", "jeffreys"]


@dataclass(frozen=True)
class PreferenceSpace:
    """The objectives of a vector reward and the preferences a user may have over them.

    Instances hold no tensors: they are immutable, hashable and cheap to pickle, so that every
    component can keep one.

    Args:
        objectives (Sequence[str]): the names of the ``K`` objectives, in the order of the reward
            vector.
        static (Mapping[str, float], optional): objectives with a constant weight, which no
            preference changes. Stored as ``(name, weight)`` pairs in the order of ``objectives``.

    Raises:
        TypeError: if ``objectives`` is a single string.
        ValueError: if there is no objective or no tunable one, if a name is empty, repeated or
            (for ``static``) unknown, or if a static weight is not finite.

    Example:
        >>> import torch
        >>> space = PreferenceSpace(("core", "distance", "efficiency"), static={"core": 1.0})
        >>> space.num_objectives, space.tunable, space.tunable_indices
        (3, ('distance', 'efficiency'), (1, 2))
        >>> space.weights(torch.tensor([0.25, 0.75]))
        tensor([1.0000, 0.2500, 0.7500])

    """

    objectives: tuple[str, ...]
    static: tuple[tuple[str, float], ...] | Mapping[str, float] = ()

    def __post_init__(self) -> None:
        if isinstance(self.objectives, str):
            raise TypeError(f"objectives must be a sequence of names, got {self.objectives!r}.")
        objectives = tuple(self.objectives)
        if not objectives:
            raise ValueError("objectives must hold at least one name, got none.")
        for position, name in enumerate(objectives):
            if not isinstance(name, str) or not name:
                raise ValueError(
                    f"objectives[{position}] must be a non-empty string, got {name!r}."
                )
            if name in objectives[:position]:
                raise ValueError(
                    f"objectives[{position}] repeats {name!r}; every objective needs its own name."
                )
        static = dict(self.static)
        for name, weight in static.items():
            if name not in objectives:
                raise ValueError(
                    f"static objective {name!r} is not an objective; allowed: {objectives}."
                )
            if not (isinstance(weight, numbers.Real) and math.isfinite(weight)):
                raise ValueError(f"the static weight of {name!r} must be finite, got {weight!r}.")
        if len(static) == len(objectives):
            raise ValueError(
                f"all objectives {objectives} are static; at least one must be tunable."
            )
        # A tuple keeps the dataclass hashable, and the fixed order makes equal spaces compare
        # equal.
        pairs = tuple((name, float(static[name])) for name in objectives if name in static)
        object.__setattr__(self, "objectives", objectives)
        object.__setattr__(self, "static", pairs)

    @property
    def num_objectives(self) -> int:
        """The length ``K`` of the reward vector."""
        return len(self.objectives)

    @property
    def tunable(self) -> tuple[str, ...]:
        """The names of the objectives that a preference weighs, in the order of its entries."""
        return tuple(self.objectives[index] for index in self.tunable_indices)

    @property
    def num_tunable(self) -> int:
        """The length ``T`` of a preference."""
        return len(self.objectives) - len(self.static)

    @property
    def tunable_indices(self) -> tuple[int, ...]:
        """The positions of the tunable objectives in the reward vector."""
        static = dict(self.static)
        return tuple(i for i, name in enumerate(self.objectives) if name not in static)

    def validate(self, preference: Tensor | Sequence, *, tol: float = 1e-4) -> Tensor:
        """Check that every row is a point of the simplex and return it as a floating point tensor.

        Args:
            preference (Tensor or nested sequence): preferences of shape ``[*B, T]``.

        Keyword Args:
            tol (float): how far the sum of a row may be from one.

        Returns:
            The preference, of shape ``[*B, T]``, with its values unchanged.

        Raises:
            ValueError: if the last dimension is not ``T``, if an entry is negative or not finite,
                or if a row does not sum to one. The message names the value, where it stands and
                what is allowed.

        Example:
            >>> space = PreferenceSpace(("distance", "efficiency"))
            >>> space.validate([0.25, 0.75])
            tensor([0.2500, 0.7500])
            >>> space.validate([1.25, -0.25])
            Traceback (most recent call last):
            ...
            ValueError: preference[1] = -0.25 for objective 'efficiency' must be finite and >= 0.

        """
        try:
            preference = torch.as_tensor(preference)
        except (TypeError, ValueError, RuntimeError) as error:
            reason = str(error).splitlines()[0]
            raise ValueError(f"preference is no array of numbers: {reason}") from error
        if preference.is_complex():
            raise ValueError(f"preference is no array of real numbers: it is {preference.dtype}.")
        if not tol >= 0:
            raise ValueError(f"tol must be a number, at least 0, got {tol}.")
        if not preference.is_floating_point():
            preference = preference.to(torch.get_default_dtype())
        self.check_shape(preference)
        if _on_simplex(preference, tol):
            return preference
        invalid = ~(preference.isfinite() & (preference >= 0))
        if invalid.any():
            position = tuple(invalid.nonzero()[0].tolist())
            index = ", ".join(map(str, position))
            raise ValueError(
                f"preference[{index}] = {preference[position].item():g} for objective "
                f"{self.tunable[position[-1]]!r} must be finite and >= 0."
            )
        total = preference.sum(-1)
        invalid = (total - 1).abs() > tol
        if invalid.any():
            position = tuple(invalid.nonzero()[0].tolist())
            index = f"[{', '.join(map(str, position))}]" if position else ""
            raise ValueError(
                f"preference{index} = {preference[position].tolist()} over {self.tunable} "
                f"sums to {total[position].item():g}; it must sum to 1 within {tol:g}."
            )
        return preference

    def weights(self, preference: Tensor) -> Tensor:
        """Fill the static weights in, giving one weight per entry of the reward vector.

        Differentiable and traceable by :func:`torch.compile`; values are not checked, for that see
        :meth:`validate`.

        Args:
            preference (Tensor): preferences of shape ``[*B, T]``.

        Returns:
            Weights of shape ``[*B, K]``.

        Raises:
            ValueError: if the last dimension of the preference is not ``T``.

        """
        self.check_shape(preference)
        static = dict(self.static)
        tunable = iter(preference.unbind(-1))
        columns = [
            preference.new_full(preference.shape[:-1], static[name])
            if name in static
            else next(tunable)
            for name in self.objectives
        ]
        return torch.stack(columns, -1)

    def sample(
        self,
        shape: int | Iterable[int] = (),
        distribution: SamplingDistribution = "dirichlet",
        generator: torch.Generator | None = None,
        device: torch.device | str | None = None,
    ) -> Tensor:
        """Draw preferences at random.

        Args:
            shape (int or Iterable[int]): the batch shape ``*B``.
            distribution (str): ``"dirichlet"`` is uniform on the simplex. ``"abs_normal"`` is the absolute
                value of a standard normal vector divided by its sum, as in the code of PD-MORL
                (https://arxiv.org/abs/2208.07914): denser in the middle, rarer at the corners (the
                density is proportional to the Euclidean norm to the power ``-T``). ``"jeffreys"`` is
                Dirichlet(1/2), the normalised squares of a standard normal vector: denser at edges
                and corners, where users and test grids are.
            generator (torch.Generator, optional): the source of randomness.
            device (torch.device, optional): where to create the tensor. Defaults to the device of
                the generator, if any.

        Returns:
            Preferences of shape ``[*B, T]``.

        Raises:
            ValueError: if the distribution is unknown.

        Example:
            >>> import torch
            >>> space = PreferenceSpace(("demo", "distance", "efficiency"))
            >>> preference = space.sample((4, 2))
            >>> preference.shape, bool(preference.sum(-1).allclose(torch.ones(4, 2)))
            (torch.Size([4, 2, 3]), True)

        """
        check_distribution(distribution)
        shape = (shape,) if isinstance(shape, int) else tuple(shape)
        if device is None and generator is not None:
            device = generator.device
        size = (*shape, self.num_tunable)
        if self.num_tunable == 1:
            return torch.ones(size, device=device)
        if distribution == "dirichlet":
            value = torch.empty(size, device=device).exponential_(generator=generator)
        else:
            value = randn(size, generator, device).abs()
            if distribution == "jeffreys":
                value = value.square()
        return value / value.sum(-1, keepdim=True)

    def corners(self) -> Tensor:
        """The ``T`` preferences for one objective alone, shape ``[T, T]``."""
        return torch.eye(self.num_tunable)

    def lattice(self, divisions: int) -> Tensor:
        """The regular lattice of the simplex, in lexicographic order.

        Points are built from integers, so that none is lost to rounding (as when a grid of floats
        is filtered by ``sum == 1``).

        Args:
            divisions (int): the number of steps along an edge, at least one.

        Returns:
            The ``binomial(divisions + T - 1, T - 1)`` preferences whose entries are multiples of
            ``1 / divisions``, shape ``[N, T]``.

        Raises:
            ValueError: if there is less than one division.

        Example:
            >>> PreferenceSpace(("distance", "efficiency")).lattice(2)
            tensor([[0.0000, 1.0000],
                    [0.5000, 0.5000],
                    [1.0000, 0.0000]])

        """
        check_count("divisions", divisions, 1)
        if comb(divisions + self.num_tunable - 1, self.num_tunable - 1) > _MOST_PREFERENCES:
            raise ValueError(
                f"divisions must give at most {_MOST_PREFERENCES:,} preferences, got {shown(divisions)}."
            )
        bars = self.num_tunable - 1
        last = divisions + bars
        rows = []
        for places in combinations(range(last), bars):  # stars and bars
            edges = (-1, *places, last)
            rows.append([b - a - 1 for a, b in pairwise(edges)])
        return torch.tensor(rows, dtype=torch.get_default_dtype()) / divisions

    def pairwise_grid(self, steps: int = 11) -> Tensor:
        """Preferences along every edge of the simplex: two objectives traded off, the others at 0.

        For three tunable objectives and 11 steps these are the 33 test preferences of de Heuvel et
        al. (https://arxiv.org/abs/2404.04857): ``(0, mu, 1 - mu)``, ``(mu, 1 - mu, 0)`` and
        ``(1 - mu, 0, mu)`` for ``mu = 0, 0.1 ... 1``. Every corner appears once per edge that it
        touches. Other ``T`` follow the same order: neighbours ``(T-2, T-1) ... (0, 1), (T-1, 0)``
        first, then pairs further apart; ``T = 2`` has one edge and ``T = 1`` a single point.

        Args:
            steps (int): the number of preferences along an edge, at least two.

        Returns:
            Preferences of shape ``[T (T - 1) / 2 * steps, T]``; ``[1, 1]`` for ``T = 1``.

        Raises:
            ValueError: if there are less than two steps.

        Example:
            >>> PreferenceSpace(("distance", "efficiency")).pairwise_grid(3)
            tensor([[0.0000, 1.0000],
                    [0.5000, 0.5000],
                    [1.0000, 0.0000]])

        """
        check_count("steps", steps, 2, most=_MOST_PREFERENCES)
        size = self.num_tunable
        if size == 1:
            return torch.ones(1, 1)
        edges: dict[frozenset[int], tuple[int, int]] = {}
        for gap in range(1, size // 2 + 1):
            for first in range(size - 2, -2, -1):
                pair = (first % size, (first + gap) % size)
                edges.setdefault(frozenset(pair), pair)  # opposite pairs come up twice
        grid = torch.zeros(len(edges), steps, size)
        rise = torch.arange(steps) / (steps - 1)
        for row, (first, second) in zip(grid, edges.values(), strict=True):
            row[:, first] = rise
            row[:, second] = rise.flip(0)
        return grid.flatten(0, 1)

    def check_shape(self, preference: Tensor) -> None:
        """Raise ``ValueError`` unless the last dimension has one entry per tunable objective."""
        if preference.ndim == 0 or preference.shape[-1] != self.num_tunable:
            raise ValueError(
                f"preference must have shape [..., {self.num_tunable}] for the tunable objectives "
                f"{self.tunable}, got {list(preference.shape)}."
            )


def _on_simplex(preference: Tensor, tol: float) -> bool:
    """Whether every row is, in a fifth of the time that it takes to say which row is not."""
    if not preference.numel():
        return True
    low, high = preference.sum(-1).aminmax()
    # NaN compares as false.
    return bool(preference.amin() >= 0 and low >= 1 - tol and high <= 1 + tol)


def check_preference_space(value: object) -> None:
    """Raise ``ValueError`` unless it is a :class:`PreferenceSpace`."""
    if not isinstance(value, PreferenceSpace):
        raise ValueError(f"preference_space must be a PreferenceSpace, got {reprlib.repr(value)}.")


def check_distribution(distribution: str) -> None:
    """Raise ``ValueError`` for what is not a :data:`SamplingDistribution`."""
    if distribution not in get_args(SamplingDistribution):
        raise ValueError(
            f"distribution must be one of {get_args(SamplingDistribution)}, got {distribution!r}."
        )
