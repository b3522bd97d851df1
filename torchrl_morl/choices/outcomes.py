"""What alternatives are compared by: one number an objective, in units of their scene."""

from __future__ import annotations

import torch
from numpy.typing import ArrayLike
from torch import Tensor

__all__ = ["as_outcomes", "standardize"]


def standardize(outcomes: Tensor | ArrayLike, valid: Tensor | ArrayLike | None = None) -> Tensor:
    """Outcomes as differences from the average of their scene, in standard deviations.

    What a person sees are differences between what could have happened in one scene. In these units
    objectives of metres and of seconds can be weighed against each other, and 0 is the average
    utility under any weights. The unit is the same in all scenes: in a scene in which all drives are
    nearly alike, there is little to like better.

    Args:
        outcomes: ``[*S, P, T]``: of ``P`` alternatives in every scene, higher is better.
        valid: which of them count, ``[*S, P]``: a drive that failed has no time. Default: all.

    Returns:
        ``[*S, P, T]``. An objective in which all alternatives of every scene are alike is 0. What is
        not valid is as bad as the worst of its scene that is, in everything, and 0 in a scene without
        anything valid.

    Raises:
        ValueError: for other shapes, or for a valid outcome that is not finite.

    Example:
        >>> standardize([[[1.0, 5.0], [3.0, 5.0]]])
        tensor([[[-1.,  0.],
                 [ 1.,  0.]]])
    """
    values = as_outcomes(outcomes)
    mask = torch.ones(values.shape[:-1], dtype=torch.bool)
    if valid is not None:
        mask = torch.as_tensor(valid)
        if mask.dtype != torch.bool or mask.shape != values.shape[:-1]:
            raise ValueError(
                f"valid must be bool {list(values.shape[:-1])}, got {mask.dtype} {list(mask.shape)}."
            )
    mask = mask.unsqueeze(-1)
    if not values[mask.expand_as(values)].isfinite().all():
        raise ValueError("outcomes must be finite where they are valid: leave others out by valid.")
    known = values.masked_fill(~mask, torch.nan)
    mean = known.nanmean(-2, keepdim=True)
    apart = known - mean
    # Over all scenes, the root mean square of differences from their scene's average.
    deviation = apart.square().flatten(0, -2).nanmean(0).sqrt()
    # Rounding is no difference.
    flat = deviation <= 1e-6 * (1 + mean.nan_to_num(0).abs().flatten(0, -2).amax(0))
    units = (apart / deviation).masked_fill(flat, 0)
    worst = units.nan_to_num(nan=torch.inf).amin(-2, keepdim=True)
    worst = worst.masked_fill(worst.isinf(), 0)  # a scene without anything valid
    return torch.where(mask, units, worst)


def as_outcomes(outcomes: Tensor | ArrayLike, num_objectives: int | None = None) -> Tensor:
    """A float tensor of at least two dimensions.

    Raises:
        ValueError: for other shapes, or another number of objectives.
    """
    values = torch.as_tensor(outcomes)
    if not values.is_floating_point():
        values = values.to(torch.get_default_dtype())
    if values.ndim < 2 or 0 in values.shape:
        raise ValueError(
            f"outcomes must have shape [..., P, T] with at least one alternative, got "
            f"{list(values.shape)}."
        )
    if num_objectives is not None and values.shape[-1] != num_objectives:
        raise ValueError(
            f"outcomes must have {num_objectives} objectives in their last dimension, got shape "
            f"{list(values.shape)}."
        )
    return values


def finite_outcomes(outcomes: Tensor | ArrayLike, num_objectives: int) -> Tensor:
    """The same, all finite: of one that is not, nothing can be said about any.

    Raises:
        ValueError: also for what is not finite.
    """
    values = as_outcomes(outcomes, num_objectives)
    if not values.isfinite().all():
        count = int((~values.isfinite()).sum())
        raise ValueError(
            f"outcomes must be finite, {count} of {values.numel()} are not: standardize(outcomes, valid) "
            "replaces those of drives that failed."
        )
    return values
