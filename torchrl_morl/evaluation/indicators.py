"""Indicators of a policy over its preferences."""

from __future__ import annotations

from typing import Literal

import numpy as np
import scipy.stats
from torch import Tensor

from torchrl_morl._extras import from_extra

__all__ = ["expected_utility", "hypervolume", "steerability"]


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
