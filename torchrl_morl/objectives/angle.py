"""Angle between vectors, with values and gradients that survive every input."""

from __future__ import annotations

from typing import Literal, get_args

import torch
from torch import Tensor
from torch.nn import functional as F

__all__ = ["AngleForm", "angle_between"]

AngleForm = Literal["atan2", "official"]

# Upper clamp of the cosine in the official PD-MORL code: it keeps acos differentiable, at the price
# of a cap of 0.81 degrees within which the term has no gradient.
_OFFICIAL_MAX_COSINE = 0.9999


def angle_between(u: Tensor, v: Tensor, form: AngleForm = "atan2", eps: float = 1e-6) -> Tensor:
    r"""Angle between two vectors along the last dimension.

    - ``"atan2"`` is :math:`2\,\mathrm{atan2}(|\hat u - \hat v|, |\hat u + \hat v|)` on the unit
      vectors :math:`\hat u, \hat v`, in **radians**. Exact over the whole :math:`[0, \pi]`; the
      gradient with respect to ``v`` has norm :math:`1 / |v|`, also for obtuse angles, and is the
      zero subgradient where the vectors are exactly parallel or antiparallel. A vector no longer
      than ``eps`` has no direction: the angle is :math:`\pi / 2` and its gradient zero.
    - ``"official"`` is ``rad2deg(acos(clamp(cos, 0, 0.9999)))`` in **degrees**, as in the code of
      PD-MORL (https://arxiv.org/abs/2208.07914). Every obtuse angle, hence every pair of a
      preference and a vector of penalties, reads 90 degrees and has no gradient.

    Args:
        u (Tensor): vectors of shape ``[*B, T]``.
        v (Tensor): vectors of shape ``[*B, T]``; broadcasts against ``u``.
        form (str): ``"atan2"`` or ``"official"``.
        eps (float): length below which a vector counts as zero (``"atan2"`` only).

    Returns:
        The angles, of shape ``[*B]``.

    Raises:
        ValueError: if ``form`` is unknown or if the last dimensions of ``u`` and ``v`` differ.

    Example:
        >>> import torch
        >>> right, up = torch.tensor([1.0, 0.0]), torch.tensor([0.0, 2.0])
        >>> angle_between(right, up)
        tensor(1.5708)
        >>> angle_between(right, -right), angle_between(right, -right, form="official")
        (tensor(3.1416), tensor(90.))

    """
    if u.shape[-1] != v.shape[-1]:
        raise ValueError(
            f"u and v must have vectors of one length, got {tuple(u.shape)} and {tuple(v.shape)}."
        )
    if form == "official":
        cosine = F.cosine_similarity(u, v, dim=-1)
        return torch.rad2deg(torch.acos(cosine.clamp(0.0, _OFFICIAL_MAX_COSINE)))
    if form != "atan2":
        raise ValueError(f"form must be one of {get_args(AngleForm)}, got {form!r}.")
    u_norm = torch.linalg.vector_norm(u, dim=-1, keepdim=True)
    v_norm = torch.linalg.vector_norm(v, dim=-1, keepdim=True)
    u, v = u / u_norm.clamp_min(eps), v / v_norm.clamp_min(eps)
    difference = torch.linalg.vector_norm(u - v, dim=-1)
    total = torch.linalg.vector_norm(u + v, dim=-1)
    # atan2(0, 0) has a NaN gradient, so vectors without a direction leave the graph before it:
    # atan2(1, 1) is the angle pi / 2.
    defined = ((u_norm > eps) & (v_norm > eps)).squeeze(-1)
    one = torch.ones_like(total)
    return 2 * torch.atan2(torch.where(defined, difference, one), torch.where(defined, total, one))
