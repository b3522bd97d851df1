"""How near robots are to people and boxes: compiled, as it is asked several times a step."""

from __future__ import annotations

import math

import numpy as np

from .lidar import compiled


@compiled
def gaps(points, position, rows, cos, sin, boxes, people):
    """Distances of robots' centres to the nearest person's centre and the nearest box, ``[2, n]``, metres.

    Args:
        points: of goal, people and boxes in all environments, ``[2, 1 + P + B, N]``, metres.
        position: of the robots, ``[n, 2]``, metres.
        rows: their environments, ``[n]``.
        cos: of the boxes' headings, ``[B, N]``.
        sin: of them, ``[B, N]``.
        boxes: ``[N, B, 5]``.
        people: ``P``.
    """
    out = np.full((2, len(rows)), math.inf)
    for robot in range(len(rows)):
        row = rows[robot]
        for item in range(people):
            x = points[0, 1 + item, row] - position[robot, 0]
            y = points[1, 1 + item, row] - position[robot, 1]
            out[0, robot] = min(out[0, robot], math.sqrt(x * x + y * y))
        for item in range(boxes.shape[1]):
            x = points[0, 1 + people + item, row] - position[robot, 0]
            y = points[1, 1 + people + item, row] - position[robot, 1]
            c, s = cos[item, row], sin[item, row]
            along = max(abs(c * x + s * y) - boxes[row, item, 3], 0.0)
            across = max(abs(c * y - s * x) - boxes[row, item, 4], 0.0)
            out[1, robot] = min(out[1, robot], math.sqrt(along * along + across * across))
    return out


@compiled
def near_rows(points, position, cos, sin, boxes, people, human_radius, hull):
    """Environments in which a person or a box is within ``hull`` [N] of a robot's centre, ``[n]``.

    Args:
        points: as of :func:`gaps`, and the others.
        position: ``[N, 2]``.
        cos: of the boxes' headings.
        sin: of them.
        boxes: ``[N, B, 5]``.
        people: ``P``.
        human_radius: metres.
        hull: radius of each robot and what it reaches, metres.
    """
    found = np.empty(len(position), np.int64)
    count = 0
    for row in range(len(position)):
        reach, near = hull[row], False
        for item in range(people):
            x = points[0, 1 + item, row] - position[row, 0]
            y = points[1, 1 + item, row] - position[row, 1]
            near |= x * x + y * y <= (reach + human_radius) ** 2
        for item in range(boxes.shape[1]):
            x = points[0, 1 + people + item, row] - position[row, 0]
            y = points[1, 1 + people + item, row] - position[row, 1]
            c, s = cos[item, row], sin[item, row]
            along = max(abs(c * x + s * y) - boxes[row, item, 3], 0.0)
            across = max(abs(c * y - s * x) - boxes[row, item, 4], 0.0)
            near |= along * along + across * across <= reach * reach
        if near:
            found[count] = row
            count += 1
    return found[:count]
