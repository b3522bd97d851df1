"""TorchRL transforms for preferences, vector rewards and range sensors."""

from torchrl_morl.transforms.finite import CheckFinite, check_finite
from torchrl_morl.transforms.lidar import LidarMinPool, LogRange
from torchrl_morl.transforms.motion import OwnMotion
from torchrl_morl.transforms.overlay import PreferenceOverlay
from torchrl_morl.transforms.polar import PolarFeatures
from torchrl_morl.transforms.preference import PreferenceSampler
from torchrl_morl.transforms.relabel import PreferenceExpand, PreferenceRelabel
from torchrl_morl.transforms.reward import ScalarizeReward
from torchrl_morl.transforms.reward_model import RewardModelReward
from torchrl_morl.transforms.robot import (
    HullRange,
    InUnitsOf,
    IsNobody,
    MotionInUnits,
    RobotScale,
    hull_ranges,
)
from torchrl_morl.transforms.velocity import VelocityInFrame

__all__ = [
    "CheckFinite",
    "HullRange",
    "InUnitsOf",
    "IsNobody",
    "LidarMinPool",
    "LogRange",
    "MotionInUnits",
    "OwnMotion",
    "PolarFeatures",
    "PreferenceExpand",
    "PreferenceOverlay",
    "PreferenceRelabel",
    "PreferenceSampler",
    "RewardModelReward",
    "RobotScale",
    "ScalarizeReward",
    "VelocityInFrame",
    "check_finite",
    "hull_ranges",
]
