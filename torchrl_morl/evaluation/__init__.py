"""Evaluation: rollouts over preferences and metrics of trajectories."""

from .metrics import min_human_distance, path_length, steerability, time_to_goal
from .plots import PREFERENCE_COLORS, draw_paths, draw_scene
from .rollout import episode_mask, rollout_preferences

__all__ = [
    "PREFERENCE_COLORS",
    "draw_paths",
    "draw_scene",
    "episode_mask",
    "min_human_distance",
    "path_length",
    "rollout_preferences",
    "steerability",
    "time_to_goal",
]
