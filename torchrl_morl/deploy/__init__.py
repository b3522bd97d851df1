"""Policies and reward models outside training: what a robot runs, and files that are safe to open."""

from .config import literal_config, training_config
from .lidar import LidarGeometry
from .policy import Policy
from .policy_files import load_policy, save_policy
from .reward_model import load_reward_model, save_reward_model
from .runner import Command, PolicyRunner
from .sensing import Limits, Sensing

__all__ = [
    "Command",
    "LidarGeometry",
    "Limits",
    "Policy",
    "PolicyRunner",
    "Sensing",
    "literal_config",
    "load_policy",
    "load_reward_model",
    "save_policy",
    "save_reward_model",
    "training_config",
]
