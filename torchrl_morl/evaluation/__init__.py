"""Evaluation: rollouts over preferences, metrics of trajectories, pictures and videos."""

from .frechet import discrete_frechet, resample_path
from .indicators import (
    expected_utility,
    hypervolume,
    non_dominated,
    sparsity,
    steerability,
)
from .intervals import (
    Interval,
    bootstrap_interval,
    cluster_rate_interval,
    interquartile_mean,
    wilson_interval,
)
from .metrics import path_length, spl, stl, time_to_goal
from .motion import cumulative_heading_change, mean_jerk, path_irregularity, stalled_time
from .overlay import draw_preference, preference_strip
from .plots import PREFERENCE_COLORS, draw_paths, draw_scene
from .proximity import (
    human_exposure,
    min_clearance,
    min_human_distance,
    min_surface_distance,
    min_time_to_collision,
    personal_space_compliance,
    space_violations,
)
from .rollout import episode_mask, rollout_preferences
from .shortest_path import shortest_path_length
from .statistics import TestResult, cohen_d, cohen_dz, significance_mark, t_test
from .video import VideoLogger, write_video

__all__ = [
    "PREFERENCE_COLORS",
    "Interval",
    "TestResult",
    "VideoLogger",
    "bootstrap_interval",
    "cluster_rate_interval",
    "cohen_d",
    "cohen_dz",
    "cumulative_heading_change",
    "discrete_frechet",
    "draw_paths",
    "draw_preference",
    "draw_scene",
    "episode_mask",
    "expected_utility",
    "human_exposure",
    "hypervolume",
    "interquartile_mean",
    "mean_jerk",
    "min_clearance",
    "min_human_distance",
    "min_surface_distance",
    "min_time_to_collision",
    "non_dominated",
    "path_irregularity",
    "path_length",
    "personal_space_compliance",
    "preference_strip",
    "resample_path",
    "rollout_preferences",
    "shortest_path_length",
    "significance_mark",
    "space_violations",
    "sparsity",
    "spl",
    "stalled_time",
    "steerability",
    "stl",
    "t_test",
    "time_to_goal",
    "wilson_interval",
    "write_video",
]
