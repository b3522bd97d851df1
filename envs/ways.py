"""Whether there is a way around boxes: compiled, as every scene that is drawn is asked for it."""

from __future__ import annotations

import math

import numpy as np

from .lidar import compiled

_TOLERANCE = 1e-6
"""Metres by which a way may touch the boxes around whose corners it leads."""


@compiled
def _meets(x, y, u, v, half_length, half_width):
    """Whether the segment from (x, y) to (u, v) meets a box, in the frame of the box."""
    near, far = 0.0, 1.0
    for start, end, half in ((x, u, half_length), (y, v, half_width)):
        way = end - start
        if abs(way) < 1e-12:
            if abs(start) > half:
                return False
        else:
            one, other = (-half - start) / way, (half - start) / way
            near, far = max(near, min(one, other)), min(far, max(one, other))
    return near <= far


@compiled
def leads_around(start, goal, boxes):
    """Whether straight lines between the corners of boxes lead from start to goal, bool ``[n]``.

    Args:
        start: ``[n, 2]``, metres.
        goal: ``[n, 2]``.
        boxes: that must not be entered, ``[n, M, 5]``: x, y, yaw, half length, half width.
    """
    n, count = boxes.shape[:2]
    found = np.zeros(n, np.bool_)
    nodes = np.empty((2 + 4 * count, 2))
    seen = np.empty((count, 2 + 4 * count, 2))
    queue = np.empty(2 + 4 * count, np.int64)
    for scene in range(n):
        nodes[0], nodes[1] = start[scene], goal[scene]
        for item in range(count):
            x, y, yaw, length, width = boxes[scene, item]
            cos, sin = math.cos(yaw), math.sin(yaw)
            for corner in range(4):
                along = length if corner < 2 else -length
                across = width if corner % 2 else -width
                nodes[2 + 4 * item + corner, 0] = x + cos * along - sin * across
                nodes[2 + 4 * item + corner, 1] = y + sin * along + cos * across
        for item in range(count):
            x, y, yaw, length, width = boxes[scene, item]
            cos, sin = math.cos(yaw), math.sin(yaw)
            for node in range(len(nodes)):
                dx, dy = nodes[node, 0] - x, nodes[node, 1] - y
                seen[item, node, 0] = cos * dx + sin * dy
                seen[item, node, 1] = cos * dy - sin * dx
        left = np.ones(len(nodes), np.bool_)
        left[0] = False
        queue[0] = 0
        first, last = 0, 1
        while first < last and not found[scene]:
            here = queue[first]
            first += 1
            for node in range(1, len(nodes)):
                if not left[node]:
                    continue
                free = True
                for item in range(count):
                    if _meets(
                        seen[item, here, 0],
                        seen[item, here, 1],
                        seen[item, node, 0],
                        seen[item, node, 1],
                        boxes[scene, item, 3] - _TOLERANCE,
                        boxes[scene, item, 4] - _TOLERANCE,
                    ):
                        free = False
                        break
                if free:
                    if node == 1:
                        found[scene] = True
                        break
                    left[node] = False
                    queue[last] = node
                    last += 1
    return found
