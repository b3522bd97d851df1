"""Evaluation: rollouts over preferences, metrics of trajectories, pictures and videos."""

from .frechet import discrete_frechet, resample_path
from .indicators import steerability
from .metrics import path_length, spl, stl, time_to_goal
from .motion import cumulative_heading_change, mean_jerk, path_irregularity, stalled_time
from .overlay import draw_preference
from .plots import PREFERENCE_COLORS, draw_paths, draw_scene
from .proximity import (
    min_clearance,
    min_human_distance,
    min_surface_distance,
    min_time_to_collision,
    personal_space_compliance,
    space_violations,
)
from .rollout import episode_mask, rollout_preferences
from .video import VideoLogger, write_video

__all__ = [
    "PREFERENCE_COLORS",
    "VideoLogger",
    "cumulative_heading_change",
    "discrete_frechet",
    "draw_paths",
    "draw_preference",
    "draw_scene",
    "episode_mask",
    "mean_jerk",
    "min_clearance",
    "min_human_distance",
    "min_surface_distance",
    "min_time_to_collision",
    "path_irregularity",
    "path_length",
    "personal_space_compliance",
    "resample_path",
    "rollout_preferences",
    "space_violations",
    "spl",
    "stalled_time",
    "steerability",
    "stl",
    "time_to_goal",
    "write_video",
]
