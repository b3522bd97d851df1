"""Evaluation: rollouts over preferences, metrics of trajectories, pictures and videos."""

from .frechet import discrete_frechet, resample_path
from .metrics import min_human_distance, path_length, steerability, time_to_goal
from .overlay import draw_preference
from .plots import PREFERENCE_COLORS, draw_paths, draw_scene
from .rollout import episode_mask, rollout_preferences
from .video import VideoLogger, write_video

__all__ = [
    "PREFERENCE_COLORS",
    "VideoLogger",
    "discrete_frechet",
    "draw_paths",
    "draw_preference",
    "draw_scene",
    "episode_mask",
    "min_human_distance",
    "path_length",
    "resample_path",
    "rollout_preferences",
    "steerability",
    "time_to_goal",
    "write_video",
]
