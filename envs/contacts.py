"""How near robots are to people and boxes: compiled, as it is asked several times a step."""

from __future__ import annotations

import math

import numpy as np

from .lidar import compiled


@compiled
def _squared_box_gap(x, y, cos, sin, half_length, half_width):
    """Squared distance from a robot's centre to a box at (x, y) from it, zero inside."""
    along = max(abs(cos * x + sin * y) - half_length, 0.0)
    across = max(abs(cos * y - sin * x) - half_width, 0.0)
    return along * along + across * across


@compiled
def _nearest(x, y, points, row, cos, sin, boxes, people):
    """Distances of a centre at (x, y) to the nearest person's centre and the nearest box."""
    person = box = math.inf
    for item in range(people):
        dx, dy = points[0, 1 + item, row] - x, points[1, 1 + item, row] - y
        person = min(person, dx * dx + dy * dy)
    for item in range(boxes.shape[1]):
        dx, dy = points[0, 1 + people + item, row] - x, points[1, 1 + people + item, row] - y
        c, s = cos[item, row], sin[item, row]
        gap = _squared_box_gap(dx, dy, c, s, boxes[row, item, 3], boxes[row, item, 4])
        box = min(box, gap)
    return math.sqrt(person), math.sqrt(box)


@compiled
def box_gaps(way, cos, sin, boxes):
    """Distances of robots' centres to the nearest box, ``[N]``, metres: zero inside, ``inf`` without boxes.

    Args:
        way: from the robots to the boxes' centres, ``[2, B, N]``, metres.
        cos: of the boxes' headings, ``[B, N]``.
        sin: of them, ``[B, N]``.
        boxes: ``[N, B, 5]``.
    """
    out = np.full(len(boxes), math.inf)
    for row in range(len(boxes)):
        for item in range(boxes.shape[1]):
            x, y, c, s = way[0, item, row], way[1, item, row], cos[item, row], sin[item, row]
            gap = _squared_box_gap(x, y, c, s, boxes[row, item, 3], boxes[row, item, 4])
            out[row] = min(out[row], gap)
    return np.sqrt(out)


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
    out = np.empty((2, len(rows)))
    for robot in range(len(rows)):
        x, y = position[robot, 0], position[robot, 1]
        near = _nearest(x, y, points, rows[robot], cos, sin, boxes, people)
        out[0, robot], out[1, robot] = near
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
        x, y = position[row, 0], position[row, 1]
        person, box = _nearest(x, y, points, row, cos, sin, boxes, people)
        if person <= hull[row] + human_radius or box <= hull[row]:
            found[count] = row
            count += 1
    return found[:count]
