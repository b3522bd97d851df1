"""Policies outside training: files that are safe to open."""

from .policy import load_policy, save_policy

__all__ = ["load_policy", "save_policy"]
