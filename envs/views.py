"""Where the cameras of the navigation task stand: from above, and behind the robot."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from .navigation_task import NavigationTask
from .people import FAR
from .rendering import Camera
from .robots import Robot

# What surrounds the scene in a picture from above, and how large a box is a wall, metres.
_MARGIN = 0.6
_WALL = 2.0


def top_view(points: Tensor, boxes: Tensor, robot: Tensor, aspect: float) -> Camera:
    """From above, the whole scene: fixed during an episode, unless the robot leaves it.

    Args:
        points: what the picture should contain, ``[P, 2]``, metres.
        boxes: ``[N, 5]`` (x, y, yaw, half length, half width). Walls, which reach far beyond the
            way, may be cut.
        robot: where the robot is now, ``[2]``.
        aspect: width of the picture over its height.
    """
    return scene_view(torch.cat((points, robot[None])), boxes, aspect)


def episode_view(
    task: NavigationTask, began: np.ndarray, index: int, robot: Tensor, aspect: float
) -> Camera:
    """:func:`top_view` of an episode.

    Args:
        task: what is where.
        began: where robot and human were at the start, ``[2, 2]``, metres.
        index: of the episode.
        robot: where the robot is now, ``[2]``.
        aspect: width of the picture over its height.
    """
    people = task.people[index]
    places = np.concatenate((began, task.goal[index, None], people[:, :2], people[:, 3:5]))
    boxes = task.boxes[index]
    places, boxes = (torch.from_numpy(one[abs(one[:, 0]) < FAR / 2]) for one in (places, boxes))
    return top_view(places, boxes, robot, aspect)


def scene_view(points: Tensor, boxes: Tensor, aspect: float) -> Camera:
    """From above, everything that is given; for a film, all paths of it.

    Args:
        points: as of :func:`top_view`.
        boxes: as of :func:`top_view`.
        aspect: width of the picture over its height.

    Examples:
        >>> points, boxes = torch.tensor([[0.0, 0.0], [9.0, 1.0]]).double(), torch.zeros(0, 5)
        >>> view = scene_view(points, boxes, aspect=2.0)
        >>> view.lookat, round(view.height, 6)  # 9 m and a margin of 0.6 m on both sides
        ((4.5, 0.5, 0.0), 5.1)
    """
    radius = boxes[:, 3:].norm(dim=-1, keepdim=True)
    radius = radius.masked_fill(radius > _WALL, -math.inf)
    low = torch.cat((points, boxes[:, :2] - radius)).amin(0)
    high = torch.cat((points, boxes[:, :2] + radius)).amax(0)
    left, bottom = (low - _MARGIN).tolist()
    right, top = (high + _MARGIN).tolist()
    centre = ((left + right) / 2, (bottom + top) / 2, 0.0)
    return Camera(centre, height=max(top - bottom, (right - left) / aspect))


def chase_view(pose: Tensor, robot: Robot) -> Camera:
    """From behind and above a robot at ``pose`` [3] (x, y in metres, heading in radians)."""
    x, y, yaw = pose.tolist()
    ahead, height = 1.5, 0.5 * robot.height + 0.3
    lookat = (x + ahead * math.cos(yaw), y + ahead * math.sin(yaw), height)
    return Camera(lookat, math.degrees(yaw), -24.0, 3.6 + robot.height)
