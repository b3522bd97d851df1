"""Networks and other modules for multi-objective reinforcement learning."""

from torchrl_morl.modules.exploration import HeldEGreedyModule
from torchrl_morl.modules.interpolator import PreferenceInterpolator
from torchrl_morl.modules.networks import make_actor, make_vector_critic, saturated_fraction
from torchrl_morl.modules.reward_model import RewardModel

__all__ = [
    "HeldEGreedyModule",
    "PreferenceInterpolator",
    "RewardModel",
    "make_actor",
    "make_vector_critic",
    "saturated_fraction",
]
