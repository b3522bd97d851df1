"""Preference-conditioned multi-objective reinforcement learning for TorchRL.

A policy reads a preference, a point of the simplex over the tunable objectives of a vector reward,
and follows it without being trained again. Start at :class:`PreferenceSpace`; transforms, losses,
modules, evaluation and policy files are in the subpackages of these names.
"""

from torchrl_morl.preferences import PreferenceSpace
from torchrl_morl.segments import PreferenceSegments

__version__ = "0.2.0"

__all__ = ["PreferenceSegments", "PreferenceSpace", "__version__"]
