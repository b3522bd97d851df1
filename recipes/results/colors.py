"""One colour per preference: mixtures of three that differ in hue and in lightness.

The three are told apart without red-green vision and in print without colour.
"""

from __future__ import annotations

import numpy as np
from matplotlib.colors import LinearSegmentedColormap, to_rgb
from numpy.typing import ArrayLike, NDArray

CORNERS = {"demo": "#d6336c", "distance": "#0b3c8c", "efficiency": "#f2b705"}
"""Colours of the objectives."""

LABELS = {"demo": "demonstration", "distance": "distance", "efficiency": "efficiency"}


def preference_colors(preferences: ArrayLike, objectives: list[str]) -> NDArray[np.float64]:
    """Colours ``[P, 3]`` of preferences ``[P, K]``: mixtures of those of the objectives.

    Raises:
        ValueError: for an objective without a colour.
    """
    unknown = set(objectives) - CORNERS.keys()
    if unknown:
        raise ValueError(f"No colour for {sorted(unknown)}: known are {sorted(CORNERS)}.")
    corners = np.array([to_rgb(CORNERS[name]) for name in objectives])
    return np.asarray(preferences, dtype=float) @ corners


def edge_map(first: str, second: str) -> LinearSegmentedColormap:
    """Colours between two objectives, the same as of :func:`preference_colors`."""
    return LinearSegmentedColormap.from_list(f"{first}_{second}", [CORNERS[first], CORNERS[second]])
