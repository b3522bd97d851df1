"""Networks and other modules for multi-objective reinforcement learning."""

from torchrl_morl.modules.exploration import HeldEGreedyModule
from torchrl_morl.modules.interpolator import PreferenceInterpolator, ValueSpace
from torchrl_morl.modules.networks import make_actor, make_vector_critic, saturated_fraction
from torchrl_morl.modules.reward_model import RewardModel
from torchrl_morl.modules.standardized import (
    StandardizedLinear,
    fold_standardization,
    standardize_inputs,
)

__all__ = [
    "HeldEGreedyModule",
    "PreferenceInterpolator",
    "RewardModel",
    "StandardizedLinear",
    "ValueSpace",
    "fold_standardization",
    "make_actor",
    "make_vector_critic",
    "saturated_fraction",
    "standardize_inputs",
]
