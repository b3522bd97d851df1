"""Networks and other modules for multi-objective reinforcement learning."""

from torchrl_morl.modules.interpolator import PreferenceInterpolator
from torchrl_morl.modules.networks import make_actor, make_vector_critic, saturated_fraction

__all__ = ["PreferenceInterpolator", "make_actor", "make_vector_critic", "saturated_fraction"]
