"""Indicators of a policy over its preferences."""

from __future__ import annotations

from typing import Literal

import numpy as np
import scipy.stats
from torch import Tensor

from torchrl_morl._extras import from_extra

__all__ = ["expected_utility", "hypervolume", "non_dominated", "sparsity", "steerability"]


def steerability(preference: Tensor, metric: Tensor) -> float:
    """Spearman rank correlation between the entry of a preference and the metric it steers.

    Args:
        preference: ``[P]``, values of one entry.
        metric: ``[P]``, the metric's mean at each of them.

    Returns:
        Rho in [-1, 1]; NaN if either is constant or holds NaN.

    Examples:
        >>> import torch
        >>> round(steerability(torch.tensor([0.0, 0.5, 1.0]), torch.tensor([0.4, 0.9, 1.3])), 3)
        1.0
    """
    first, second = np.asarray(preference, dtype=float), np.asarray(metric, dtype=float)
    if np.isnan(first).any() or np.isnan(second).any():
        return float("nan")
    if np.ptp(first) == 0 or np.ptp(second) == 0:
        return float("nan")
    return float(scipy.stats.spearmanr(first, second).statistic)


def hypervolume(values: Tensor, reference: Tensor) -> float:
    """Volume that a set of points dominates, down to a reference; larger is better.

    Zitzler and Thiele, https://doi.org/10.1109/4235.797969, computed by moocore
    (https://multi-objective.github.io/moocore/). Points that do not exceed the reference in all
    objectives add nothing. The number has the units of all objectives multiplied, and depends on
    the reference: state it.

    Args:
        values: ``[P, K]``, one point a preference, larger is better in every objective.
        reference: ``[K]``.

    Returns:
        The volume; NaN if a value is.

    Raises:
        ValueError: if the shapes do not fit.
        ImportError: without moocore (``pip install 'torchrl-morl[indicators]'``).

    Examples:
        Two rectangles of 1 x 3 and 2 x 1, which share 1 x 1.

        >>> import torch
        >>> hypervolume(torch.tensor([[1.0, 3.0], [2.0, 1.0]]), torch.zeros(2))
        4.0
    """
    points, corner = np.asarray(values, dtype=float), np.asarray(reference, dtype=float)
    if points.ndim != 2 or corner.shape != points.shape[1:]:
        raise ValueError(
            f"values must be [P, K] and reference [K], got {points.shape} and {corner.shape}."
        )
    if np.isnan(points).any() or np.isnan(corner).any():
        return float("nan")
    with from_extra("indicators", "hypervolume"):
        import moocore

    return float(moocore.hypervolume(points, ref=corner, maximise=True))


def non_dominated(values: Tensor) -> np.ndarray:
    """Which points no other one dominates; of equal points the first.

    Args:
        values: ``[P, K]``, larger is better in every objective.

    Returns:
        Booleans ``[P]``.

    Raises:
        ValueError: for values that are no table, or NaN.
        ImportError: without moocore (``pip install 'torchrl-morl[indicators]'``).

    Examples:
        >>> non_dominated([[1.0, 3.0], [2.0, 1.0], [1.0, 2.0], [2.0, 1.0]]).tolist()
        [True, True, False, False]
    """
    points = np.asarray(values, dtype=float)
    if points.ndim != 2 or np.isnan(points).any():
        raise ValueError(f"values must be numbers [P, K] without NaN, got {points.shape}.")
    with from_extra("indicators", "non_dominated"):
        import moocore

    return np.asarray(moocore.is_nondominated(points, maximise=True), dtype=bool)


def sparsity(values: Tensor) -> float:
    r"""Mean squared gap between neighbours of a front, as Xu et al. (2020) report it beside hypervolume.

    .. math::
        \frac{1}{P - 1} \sum_k \sum_i (v^k_{(i)} - v^k_{(i+1)})^2

    over the :math:`P` points that none dominates, sorted in each objective (PGMORL,
    https://proceedings.mlr.press/v119/xu20h.html). **It misleads**: a policy that does the same under
    every preference has one point, and the best value there is, 0. Read it beside
    :func:`hypervolume` and :func:`expected_utility`, never alone; MORL-Baselines advises against it.

    Args:
        values: ``[P, K]``, larger is better in every objective.

    Returns:
        The sparsity, in squared units of the objectives; 0 for a single point.

    Raises:
        ValueError: for values that are no table, or NaN.
        ImportError: without moocore (``pip install 'torchrl-morl[indicators]'``).

    Examples:
        >>> sparsity([[0.0, 4.0], [1.0, 2.0], [3.0, 0.0]])  # (1 + 4 + 4 + 4) / 2
        6.5
        >>> sparsity([[1.0, 1.0]])
        0.0
    """
    points = np.asarray(values, dtype=float)
    front = points[non_dominated(points)]
    if len(front) < 2:
        return 0.0
    return float(np.square(np.diff(np.sort(front, axis=0), axis=0)).sum() / (len(front) - 1))


def expected_utility(
    weights: Tensor, values: Tensor, *, choice: Literal["best", "commanded"] = "best"
) -> float:
    r"""Mean utility :math:`w \cdot v` over weights; larger is better.

    ``"best"`` gives every weight the point that suits it best, whichever preference it came from:
    the expected utility metric of Zintgraf et al. (2015), as morl-baselines computes it. With
    ``"commanded"`` row ``i`` is what the policy did under weight ``i``. What lies between the two
    is lost by a policy that has a behaviour but does not show it when asked.

    Args:
        weights: ``[P, K]``.
        values: ``[P, K]``, for ``"best"`` any number of rows.

    Keyword Args:
        choice: of the point for each weight.

    Returns:
        The utility, in units of the values; NaN if a value is.

    Raises:
        ValueError: if the shapes do not fit, or for another choice.

    Examples:
        >>> import torch
        >>> weights = torch.eye(2)
        >>> values = torch.tensor([[0.0, 3.0], [2.0, 0.0]])  # the wrong way round
        >>> expected_utility(weights, values), expected_utility(weights, values, choice="commanded")
        (2.5, 0.0)
    """
    weights, values = np.asarray(weights, dtype=float), np.asarray(values, dtype=float)
    if choice not in ("best", "commanded"):
        raise ValueError(f"choice must be 'best' or 'commanded', got {choice!r}.")
    fits = weights.ndim == values.ndim == 2 and weights.shape[1] == values.shape[1]
    if not fits or (choice == "commanded" and len(weights) != len(values)):
        raise ValueError(
            f"weights and values must be [P, K], got {weights.shape} and {values.shape}."
        )
    utility = weights @ values.T
    return float((utility.max(1) if choice == "best" else np.diag(utility)).mean())
