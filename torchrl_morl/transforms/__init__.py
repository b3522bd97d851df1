"""TorchRL transforms for preferences, vector rewards and range sensors."""

from torchrl_morl.transforms.lidar import LidarMinPool
from torchrl_morl.transforms.polar import PolarFeatures
from torchrl_morl.transforms.preference import PreferenceSampler
from torchrl_morl.transforms.relabel import PreferenceExpand, PreferenceRelabel
from torchrl_morl.transforms.reward import ScalarizeReward

__all__ = [
    "LidarMinPool",
    "PolarFeatures",
    "PreferenceExpand",
    "PreferenceRelabel",
    "PreferenceSampler",
    "ScalarizeReward",
]
