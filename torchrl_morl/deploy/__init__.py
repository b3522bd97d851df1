"""Policies and reward models outside training: what a robot runs, and files that are safe to open."""

from .config import literal_config, training_config
from .graph import PolicyGraph
from .hub import from_hub, push_to_hub
from .lidar import LidarGeometry
from .onnx_export import export_onnx, training_lidar
from .policy import Policy
from .policy_files import load_policy, save_policy
from .reward_model import load_reward_model, save_reward_model
from .runner import Command, PolicyRunner, Runner
from .sensing import Limits, Sensing

__all__ = [
    "Command",
    "LidarGeometry",
    "Limits",
    "Policy",
    "PolicyGraph",
    "PolicyRunner",
    "Runner",
    "Sensing",
    "export_onnx",
    "from_hub",
    "literal_config",
    "load_policy",
    "load_reward_model",
    "push_to_hub",
    "save_policy",
    "save_reward_model",
    "training_config",
    "training_lidar",
]
