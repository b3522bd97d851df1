"""What simulations may be asked for: refused in one line, before anything is allocated."""

from __future__ import annotations

import torch

from torchrl_morl.arguments import (
    check_count,
    check_device,
    check_flag,
    check_seed,
    is_number,
)

from .fields import shown
from .scene_numbers import METRES

MOST_ENVS = 100_000
MOST_THREADS = 4_096
MOST_RAYS = 100_000
MOST_READINGS = 1_000_000_000
"""Of all lidars together: 4 GB in single precision."""

MOST_SUBSTEPS = 10_000
"""Physics steps in a control step."""

MOST_STEPS = 2**62
"""Of an episode, which are counted in 64 bits."""

MOST_PIXELS = 16_384
"""Along a side of a picture."""


_FLOATS = (torch.float16, torch.bfloat16, torch.float32, torch.float64)


def check_simulations(
    *,
    num_envs: object,
    num_threads: object,
    frame_skip: object,
    max_episode_steps: object,
    seed: object,
    device: object,
    dtype: object,
    snapshots: object,
    from_pixels: object,
    render_width: object,
    render_height: object,
) -> None:
    """Refuse arguments of :class:`envs.BatchedMujocoEnv` that no simulation can have.

    Raises:
        ValueError: in one line, for the first of them.
    """
    check_count("num_envs", num_envs, most=MOST_ENVS)
    check_count("frame_skip", frame_skip, most=MOST_SUBSTEPS)
    check_count("max_episode_steps", max_episode_steps, most=MOST_STEPS)
    check_count("num_threads", num_threads, least=0, most=MOST_THREADS)  # 0: every CPU
    check_seed(seed)
    check_device("device", device)
    if dtype not in _FLOATS:
        raise ValueError(f"dtype must be a floating point one of PyTorch, got {shown(dtype)}.")
    check_flag("snapshots", snapshots)
    check_flag("from_pixels", from_pixels)
    check_count("render_width", render_width, most=MOST_PIXELS)
    check_count("render_height", render_height, most=MOST_PIXELS)
    if from_pixels and num_envs * render_width * render_height > MOST_READINGS:
        raise ValueError(
            f"num_envs x render_width x render_height must be at most {MOST_READINGS:,} with "
            f"from_pixels, got {num_envs} x {render_width} x {render_height}."
        )


def check_senses(
    num_envs: object, num_rays: object, max_range: object, goal_radius: object
) -> None:
    """The same of what :class:`envs.NavigationEnv` adds to them.

    Raises:
        ValueError: in one line, for the first of them.
    """
    for name, value in (("goal_radius", goal_radius), ("max_range", max_range)):
        if not (is_number(value) and value > 0):
            raise ValueError(f"{name} must be positive, got {shown(value)}.")
        if value > METRES[1]:
            raise ValueError(f"{name} must be at most {METRES[1]:g} m, got {shown(value)}.")
    check_count("num_rays", num_rays, most=MOST_RAYS)
    check_count("num_envs", num_envs, most=MOST_ENVS)
    if num_envs * num_rays > MOST_READINGS:
        raise ValueError(
            f"num_envs x num_rays must be at most {MOST_READINGS:,}, got {num_envs} x {num_rays}."
        )
