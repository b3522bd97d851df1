"""Pictures of trajectories, drawn on matplotlib axes that the caller makes."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from torch import Tensor

from torchrl_morl._extras import from_extra

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap

__all__ = ["PREFERENCE_COLORS", "draw_paths", "draw_scene"]

PREFERENCE_COLORS = "viridis"
"""Colour map of preferences: perceptually uniform and safe for colour-blind readers."""

_FURTHEST = 100.0
"""From the start, metres: what is further away stands for nothing."""


def draw_scene(
    ax: Axes,
    *,
    start: Tensor,
    goal: Tensor,
    human: Tensor,
    boxes: Tensor,
    human_radius: float,
    goal_radius: float,
    marker_scale: float = 1.0,
) -> None:
    """Draw start, goal, human and boxes seen from above.

    They are black, white and grey: colours are left to preferences. Boxes and a human more than 100 m from
    the start stand for none, and are not drawn.

    Args:
        ax: axes in metres; their aspect is set to equal.

    Keyword Args:
        start: ``[2]`` or more entries.
        goal: ``[2]``.
        human: ``[3]``, x, y and heading.
        boxes: ``[M, 5]``: x, y, yaw, half length, half width.
        human_radius: metres.
        goal_radius: metres.
        marker_scale: size of start, goal and heading, for small pictures.

    Raises:
        ImportError: without matplotlib (``pip install 'torchrl-morl[viz]'``).
    """
    with from_extra("viz", "draw_scene"):
        from matplotlib.patches import Circle, Polygon

    begin = np.asarray(start)[:2]

    def there(x: float, y: float) -> bool:
        return math.hypot(x - begin[0], y - begin[1]) <= _FURTHEST

    for x, y, yaw, half_length, half_width in np.asarray(boxes):
        if not there(x, y):
            continue
        corners = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * [half_length, half_width]
        rotation = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
        ax.add_patch(Polygon(corners @ rotation + [x, y], facecolor="0.55", edgecolor="0.35"))
    x, y, heading = np.asarray(human)[:3]
    if there(x, y):
        ax.add_patch(
            Circle(
                (x, y),
                human_radius,
                facecolor="white",
                edgecolor="black",
                linewidth=1.8 * marker_scale,
                zorder=4,
            )
        )
        nose = 1.9 * human_radius * np.array([np.cos(heading), np.sin(heading)])
        ax.annotate(
            "",
            xy=(x + nose[0], y + nose[1]),
            xytext=(x, y),
            arrowprops={
                "arrowstyle": "-|>",
                "color": "black",
                "mutation_scale": 10 * marker_scale,
                "linewidth": marker_scale,
                "shrinkA": 0,
                "shrinkB": 0,
            },
            zorder=5,
        )
    gx, gy = np.asarray(goal)[:2]
    ax.add_patch(Circle((gx, gy), goal_radius, facecolor="none", edgecolor="0.3", linestyle="--"))
    ax.plot(gx, gy, marker="*", markersize=12 * marker_scale, color="black", zorder=5)
    sx, sy = np.asarray(start)[:2]
    ax.plot(sx, sy, marker="o", markersize=7 * marker_scale, color="black", zorder=5)
    ax.set_aspect("equal")
    ax.set_xlabel("x / m")
    ax.set_ylabel("y / m")


def draw_paths(
    ax: Axes,
    position: Tensor,
    mask: Tensor,
    values: Tensor,
    *,
    cmap: str | Colormap = PREFERENCE_COLORS,
    linewidth: float = 1.8,
) -> None:
    """Draw paths coloured by a value in [0, 1], such as an entry of the preference.

    Args:
        ax: axes in metres.
        position: ``[P, T, 2]``.
        mask: ``[P, T]``.
        values: ``[P]``.

    Keyword Args:
        cmap: colours of 0 to 1.
        linewidth: points.

    Raises:
        ImportError: without matplotlib (``pip install 'torchrl-morl[viz]'``).
    """
    with from_extra("viz", "draw_paths"):
        import matplotlib as mpl

    colors = mpl.colormaps[cmap] if isinstance(cmap, str) else cmap
    for path, valid, value in zip(
        np.asarray(position), np.asarray(mask), np.asarray(values), strict=True
    ):
        ax.plot(*path[valid].T, color=colors(float(value)), linewidth=linewidth, zorder=3)
