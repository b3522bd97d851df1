"""What the options of the TD3 loss may be."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal, get_args

from torchrl_morl.arguments import check_count
from torchrl_morl.modules import PreferenceInterpolator, ValueSpace
from torchrl_morl.preferences import check_preference_space

if TYPE_CHECKING:
    from torchrl_morl.preferences import PreferenceSpace

TargetSelection = Literal["utility", "elementwise"]

_AMOUNTS = (
    "angle_coeff_actor",
    "angle_coeff_critic",
    "pre_tanh_coeff",
    "policy_noise",
    "noise_clip",
)

_DISTANCES = ("l1", "l2", "smooth_l1")


def check_amounts(options: Mapping[str, Any]) -> None:
    """Raise a ValueError unless coefficients and noise are finite and not negative."""
    for name in _AMOUNTS:
        value = float(options.get(name, 0.0))
        if not 0 <= value < math.inf:
            raise ValueError(f"{name} must not be negative and must be finite, got {value}.")
    if "num_qvalue_nets" in options:
        check_count("num_qvalue_nets", options["num_qvalue_nets"])
    if (name := options.get("loss_function", "smooth_l1")) not in _DISTANCES:
        raise ValueError(f"loss_function must be one of {_DISTANCES}, got {name!r}.")


def check_options(
    angle: ValueSpace | None,
    target_selection: TargetSelection,
    preference_space: PreferenceSpace | None,
    interpolator: PreferenceInterpolator | None,
) -> None:
    """Raise a ValueError for an option that is unknown or contradicts another."""
    if preference_space is not None:
        check_preference_space(preference_space)
    if target_selection not in get_args(TargetSelection):
        raise ValueError(
            f"target_selection must be one of {get_args(TargetSelection)}, "
            f"got {target_selection!r}."
        )
    if angle is not None and angle not in get_args(ValueSpace):
        raise ValueError(f"angle must be None or one of {get_args(ValueSpace)}, got {angle!r}.")
    if angle is not None and interpolator is None:
        raise ValueError(
            f"angle={angle!r} needs an interpolator; for the raw preference give it "
            f"PreferenceInterpolator(torch.eye(T), identity=True, value_space={angle!r})."
        )
    if angle is not None and interpolator.value_space != angle:
        raise ValueError(
            f"angle={angle!r} compares {angle} values with directions in the "
            f"{interpolator.value_space} space of the interpolator: give it "
            f"value_space={angle!r}."
        )
    if interpolator is not None and preference_space is not None:
        have, want = interpolator.num_tunable, preference_space.num_tunable
        if have != want:
            raise ValueError(
                f"the interpolator has {have} tunable objectives, the preference space {want}."
            )
