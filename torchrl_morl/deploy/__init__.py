"""Policies and reward models outside training: files that are safe to open."""

from .policy import load_policy, save_policy
from .reward_model import load_reward_model, save_reward_model

__all__ = ["load_policy", "load_reward_model", "save_policy", "save_reward_model"]
