"""The preference interpolator of PD-MORL and the objective space that it lives in."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, get_args

import torch
from torch import Tensor, nn
from torch.nn import functional as F

__all__ = ["PreferenceInterpolator", "ValueSpace"]

ValueSpace = Literal["normalized", "raw"]

# A range narrower than this share of its end points is float noise between two key solutions:
# dividing by it would blow the normalised values up.
_MIN_RELATIVE_RANGE = 1e-6


class PreferenceInterpolator(nn.Module):
    r"""Maps a preference to the direction in which its solution is expected to lie.

    A preference says which objectives matter, not what can be reached: the returns of the policy
    for ``(0.5, 0.5)`` seldom point along ``(0.5, 0.5)``. PD-MORL
    (https://arxiv.org/abs/2208.07914) therefore compares value vectors with an interpolation
    :math:`I(\lambda)` between the returns of a few key preferences: a radial basis function fit
    with the linear kernel :math:`-|\lambda - \lambda_m|` and a constant term, equal to scipy's
    ``RBFInterpolator(kernel="linear")``. The result is scaled to unit length.

    The module also owns the normalised objective space, in which the worst key solution of every
    objective is 0 and the best is 1. Directions are taken there, because penalties point away from
    every preference in the raw space, and the objective that a policy does best has the *shortest*
    component.

    All of the state is in buffers. The coefficients change in place, so a compiled graph stays valid
    across calls of :meth:`refit`. Before the first refit the module is the identity: the direction
    is :math:`\lambda / |\lambda|` and :meth:`normalize` returns its input.

    Args:
        key_preferences (Tensor or nested sequence): the ``M`` distinct preferences whose solutions
            are known, of shape ``[M, T]``; usually the corners, ``torch.eye(T)``.

    Keyword Args:
        identity (bool): keep the direction :math:`\lambda / |\lambda|` for good; :meth:`refit` then
            moves the normalised space only. Defaults to ``False``.
        value_space (str): where directions are taken. ``"normalized"`` (default) as above. ``"raw"`` never
            normalises, as in the official code, which suits positive returns only.

    Buffers:
        - ``low``, ``high`` ``[T]``: the end points of the normalised space.
        - ``key_preferences``, ``key_solutions`` ``[M, T]``: the nodes, and the running estimate of
          their returns.
        - ``coefficients`` ``[M + 1, T]``: kernel weights and, last, the constant term.
        - ``fitted`` ``[]``: whether :meth:`refit` has been called.

    Raises:
        ValueError: if the key preferences are not a non-empty matrix of finite, distinct, non-zero
            rows, or if ``value_space`` is unknown.

    Example:
        >>> import torch
        >>> interpolator = PreferenceInterpolator(torch.eye(2))
        >>> interpolator(torch.tensor([0.5, 0.5]))
        tensor([0.7071, 0.7071])
        >>> interpolator.refit(torch.tensor([[-2.0, -9.0], [-6.0, -1.0]]))
        >>> interpolator.normalize(torch.tensor([-4.0, -1.0]))
        tensor([0.5000, 1.0000])
        >>> interpolator.refit(torch.tensor([[-6.0, -1.0], [-2.0, -5.0]]), momentum=0.5)
        >>> interpolator.key_solutions
        tensor([[-4., -5.],
                [-4., -3.]])

    """

    key_preferences: Tensor
    key_solutions: Tensor
    coefficients: Tensor
    low: Tensor
    high: Tensor
    fitted: Tensor

    def __init__(
        self,
        key_preferences: Tensor | Sequence[Sequence[float]],
        *,
        identity: bool = False,
        value_space: ValueSpace = "normalized",
    ) -> None:
        super().__init__()
        keys = torch.as_tensor(key_preferences)
        if not keys.is_floating_point():
            keys = keys.to(torch.get_default_dtype())
        keys = keys.detach().clone()
        if keys.ndim != 2 or keys.numel() == 0:
            raise ValueError(
                f"key_preferences must be a non-empty [M, T] matrix, got {tuple(keys.shape)}."
            )
        if not (keys.isfinite().all() and (keys != 0).any(-1).all()):
            raise ValueError(f"key_preferences must be finite and no row zero, got {keys}.")
        if torch.unique(keys, dim=0).shape[0] != keys.shape[0]:
            raise ValueError(f"key_preferences must be distinct, got {keys}.")
        if value_space not in get_args(ValueSpace):
            raise ValueError(
                f"value_space must be one of {get_args(ValueSpace)}, got {value_space!r}."
            )
        self.identity = identity
        self.value_space = value_space
        num_keys, num_tunable = keys.shape
        self.register_buffer("key_preferences", keys)
        self.register_buffer("key_solutions", torch.zeros_like(keys))
        self.register_buffer("coefficients", keys.new_zeros(num_keys + 1, num_tunable))
        self.register_buffer("low", keys.new_zeros(num_tunable))
        self.register_buffer("high", keys.new_ones(num_tunable))
        self.register_buffer("fitted", torch.zeros((), dtype=torch.bool, device=keys.device))

    @property
    def num_keys(self) -> int:
        """The number ``M`` of key preferences."""
        return self.key_preferences.shape[0]

    @property
    def num_tunable(self) -> int:
        """The length ``T`` of a preference."""
        return self.key_preferences.shape[1]

    def extra_repr(self) -> str:
        """Settings shown by ``repr``."""
        return (
            f"num_keys={self.num_keys}, num_tunable={self.num_tunable}, "
            f"identity={self.identity}, value_space={self.value_space!r}"
        )

    def forward(self, preference: Tensor) -> Tensor:
        """Direction of the expected solution.

        Args:
            preference (Tensor): preferences of shape ``[*B, T]``.

        Returns:
            Unit vectors of shape ``[*B, T]``.

        Raises:
            ValueError: if the last dimension is not ``T``.

        """
        self._check_last_dim("preference", preference)
        unit_preference = F.normalize(preference, dim=-1)
        if self.identity:
            return unit_preference
        # Not torch.cdist: above 25 rows it goes through a matrix product that costs half the digits.
        distance = torch.linalg.vector_norm(preference.unsqueeze(-2) - self.key_preferences, dim=-1)
        # Nor in the precision of torch.autocast: angles are small where a policy is good.
        with torch.autocast(distance.device.type, enabled=False):
            direction = self.coefficients[-1] - distance @ self.coefficients[:-1]
        return torch.where(self.fitted, F.normalize(direction, dim=-1), unit_preference)

    def normalize(self, values: Tensor) -> Tensor:
        """Map values of the tunable objectives to the normalised space.

        Args:
            values (Tensor): returns or action values of shape ``[*B, T]``, in the units of the key
                solutions.

        Returns:
            ``(values - low) / (high - low)``, of shape ``[*B, T]``. An objective in which all key
            solutions agree is shifted but not scaled.

        Raises:
            ValueError: if the last dimension is not ``T``.

        """
        self._check_last_dim("values", values)
        extent = self.high - self.low
        noise = _MIN_RELATIVE_RANGE * torch.maximum(self.low.abs(), self.high.abs())
        return (values - self.low) / torch.where(extent > noise, extent, torch.ones_like(extent))

    @torch.no_grad()
    def refit(
        self, key_solutions: Tensor | Sequence[Sequence[float]], momentum: float = 0.0
    ) -> None:
        """Take new key solutions in and fit the space and the interpolation to them.

        The running estimate becomes ``momentum * old + (1 - momentum) * new``; the first call has
        nothing to remember and takes the new solutions as they are.

        Args:
            key_solutions (Tensor or nested sequence): returns of the tunable objectives of the
                policies of the key preferences, of shape ``[M, T]``. They must be in the units of
                the values given to :meth:`normalize`: same reward scale, same discount.
            momentum (float): share of the old estimate that is kept, in ``[0, 1)``.

        Raises:
            ValueError: if the shape is not ``[M, T]``, a value is not finite or the momentum is out
                of range. The state is then unchanged.

        """
        solutions = torch.as_tensor(key_solutions).to(self.key_solutions)
        if solutions.shape != self.key_solutions.shape:
            raise ValueError(
                f"key_solutions must have shape {tuple(self.key_solutions.shape)} (one row per key "
                f"preference), got {tuple(solutions.shape)}."
            )
        if not solutions.isfinite().all():
            raise ValueError(f"key_solutions must be finite, got {solutions}.")
        if not 0.0 <= momentum < 1.0:
            raise ValueError(f"momentum must be in [0, 1), got {momentum}.")
        self.key_solutions.copy_(
            torch.where(self.fitted, torch.lerp(solutions, self.key_solutions, momentum), solutions)
        )
        if self.value_space == "normalized":
            self.low.copy_(self.key_solutions.amin(0))
            self.high.copy_(self.key_solutions.amax(0))
        self.coefficients.copy_(self._solve(self._key_directions()))
        self.fitted.fill_(True)

    def _key_directions(self) -> Tensor:
        """Unit vectors of the key solutions, ``[M, T]``."""
        points = self.normalize(self.key_solutions)
        # A key policy that is worst in every objective sits at the origin and has no direction of
        # its own; its preference is the only one left.
        has_direction = (points != 0).any(-1, keepdim=True)
        return F.normalize(torch.where(has_direction, points, self.key_preferences), dim=-1)

    def _solve(self, directions: Tensor) -> Tensor:
        """Coefficients ``[M + 1, T]`` of the linear radial basis functions through the keys."""
        # The kernel is positive definite only among weights that sum to zero; the bordering row and
        # column of ones impose that and fit the constant. Float64: the system is ill-conditioned
        # when two keys are close.
        keys = self.key_preferences.double()
        system = keys.new_ones(self.num_keys + 1, self.num_keys + 1)
        system[:-1, :-1] = -torch.linalg.vector_norm(keys.unsqueeze(1) - keys, dim=-1)
        system[-1, -1] = 0.0
        return torch.linalg.solve(system, F.pad(directions.double(), (0, 0, 0, 1)))

    def _check_last_dim(self, name: str, values: Tensor) -> None:
        # A last dimension of 1 would otherwise broadcast in silence.
        if values.shape[-1] != self.num_tunable:
            raise ValueError(
                f"{name} must have {self.num_tunable} entries in the last dimension, "
                f"got shape {tuple(values.shape)}."
            )
