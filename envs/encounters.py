"""Can the goal be reached among people who walk and do not yield? A plan is the proof.

The plan of a robot that would rather be late: turn, drive straight to a refuge beside the start, wait
there, then drive around everything that still is, and around every way that people have yet to walk. It
is made for a slow robot, so that faster ones have it, too. Where such a plan exists the scene can be
solved; where none does, it may be solvable all the same.
"""

from __future__ import annotations

import math

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_morl.geometry import segment_box_distance

from .people import absent, place_at
from .scene_checks import way_exists
from .scenes import HUMAN_RADIUS

SLOW_SPEED = 0.2
"""What the plan drives, m/s: 80 % of the slowest robots' 0.25 m/s, as servos lag behind."""

SLOW_TURN = 0.8
"""How fast it turns, rad/s."""

_SPEED_AFTER = 0.4
"""And what it drives once the way is free, m/s. Slower robots are given shorter ways."""

TIME_LIMIT = 60.0
"""An episode, seconds."""

MARGIN = 0.05
"""What it keeps from everything beyond the radii, metres."""

_WAITS = (0.0, 8.0, 14.0, 20.0, 28.0)
_REFUGES = ((0.0, 0.0), (0.0, 0.8), (0.0, -0.8), (0.0, 1.4), (0.0, -1.4))
"""Ahead of the start towards the goal and to the left of it, metres."""

_Refuges = list[tuple[tuple[float, float], float]]
_PLANS: _Refuges = [(refuge, wait) for refuge in _REFUGES for wait in _WAITS]

_TURNS = math.pi / SLOW_TURN
_FOREVER = torch.tensor(1e6, dtype=torch.float64)
# Plans of a scene that are followed to the goal before it is given up.
_ATTEMPTS = 6

# A driven way is at most so much longer than the straight line, where boxes stand about.
_DETOUR = 1.4


def solvable_among_people(scenes: TensorDictBase, robot_radius: float) -> Tensor:
    """Whether there is such a plan, bool ``[n]``.

    Args:
        scenes: ``[n]``: ``start`` [n, 3], ``goal`` [n, 2], ``boxes`` [n, B, 5] and ``people`` [n, P, 7],
            see :mod:`envs.people`.
        robot_radius: metres.

    Examples:
        Somebody walks at the robot from 9 m away, at the speed of a jogger: it would be run down. Walking,
        they leave it the time to step aside.

        >>> import torch
        >>> from tensordict import TensorDict
        >>> people = torch.tensor([[[9.0, 0, 0, -3, 0, v, 0]] for v in (1.0, 3.0)]).double()
        >>> start, goal = torch.zeros(2, 3).double(), torch.tensor([[8.0, 0.0]] * 2).double()
        >>> boxes = torch.zeros(2, 0, 5).double()
        >>> scenes = TensorDict(start=start, goal=goal, people=people, boxes=boxes, batch_size=[2])
        >>> solvable_among_people(scenes, 0.177)
        tensor([ True, False])
    """
    if not len(scenes):
        return torch.zeros(0, dtype=torch.bool)
    # Most scenes need no refuge and no wait, which is the first plan: the others are made for the rest.
    found = _follows(scenes, robot_radius, _PLANS[:1])
    rows = (~found).nonzero()[:, 0]
    if len(rows):
        found[rows] = _follows(scenes[rows], robot_radius, _PLANS[1:])
    return found


def _follows(scenes: TensorDictBase, robot_radius: float, plans: _Refuges) -> Tensor:
    """Whether one of the plans leads to the goal, bool ``[n]``."""
    found = torch.zeros(len(scenes), dtype=torch.bool)
    start, goal, boxes = scenes["start"][:, :2], scenes["goal"], scenes["boxes"]
    people = scenes["people"]
    plans = _Plans(start, goal, plans)
    good = plans.safe(boxes, people, robot_radius)
    for _ in range(min(_ATTEMPTS, good.shape[1])):
        rows = (~found & good.any(-1)).nonzero()[:, 0]
        if not len(rows):
            break
        first = good[rows].to(torch.uint8).argmax(-1)
        remaining = _swept(people[rows], plans.leaves[first], _FOREVER)
        obstacles = torch.cat((boxes[rows], remaining), dim=1)
        grown = torch.full(obstacles.shape[:-1], robot_radius + MARGIN, dtype=torch.float64)
        grown[:, boxes.shape[1] :] += HUMAN_RADIUS
        found[rows] = way_exists(plans.place[rows, first], goal[rows], obstacles, grown)
        good[rows, first] = False
    return found


class _Plans:
    """Every refuge with every wait, ``C`` plans in each of ``n`` scenes."""

    def __init__(self, start: Tensor, goal: Tensor, refuges: _Refuges) -> None:
        offset = torch.tensor([refuge for refuge, _ in refuges], dtype=torch.float64)
        waits = torch.tensor([wait for _, wait in refuges], dtype=torch.float64)
        way = goal - start
        ahead = way / way.norm(dim=-1, keepdim=True)
        left = torch.stack((-ahead[:, 1], ahead[:, 0]), dim=-1)
        self.start = start[:, None]
        self.place = self.start + offset[:, :1] * ahead[:, None] + offset[:, 1:] * left[:, None]
        far = offset.norm(dim=-1)
        # Half a turn at most, there and once more when it drives on.
        self.there = torch.where(far > 0, _TURNS + far / SLOW_SPEED, 0.0)
        self.leaves = torch.maximum(waits, self.there)
        drive = _DETOUR * (goal[:, None] - self.place).norm(dim=-1) / _SPEED_AFTER
        self.in_time = self.leaves + _TURNS + drive <= TIME_LIMIT

    def safe(self, boxes: Tensor, people: Tensor, robot_radius: float) -> Tensor:
        """Which get the robot to its refuge and let it wait there, bool ``[n, C]``."""
        apart = robot_radius + HUMAN_RADIUS + MARGIN
        # A walk is seen from each plan: its own time there, and its own time of waiting.
        each = people[:, None].expand(-1, len(self.there), -1, -1)
        coming = _swept(each, torch.zeros_like(self.there), self.there)
        waiting = _swept(each, self.there, self.leaves + _TURNS)
        start, place = self.start[:, :, None], self.place[:, :, None]
        room = segment_box_distance(start, place, boxes[:, None]) > robot_radius + MARGIN
        good = self.in_time & room.all(-1)
        good &= (segment_box_distance(start, place, coming) > apart).all(-1)
        return good & (segment_box_distance(place, place, waiting) > apart).all(-1)


def _swept(people: Tensor, begin: Tensor, end: Tensor) -> Tensor:
    """Boxes without width ``[*B, P, 5]`` over where the centres of people are in that time.

    Args:
        people: ``[*B, P, 7]``.
        begin: ``[C]``, the last dimension of ``B``, seconds.
        end: the same, or infinity.
    """
    first, last = place_at(people, begin[..., None]), place_at(people, end[..., None])
    way = last - first
    boxes = torch.full((*people.shape[:-1], 5), 1e-4, dtype=torch.float64)
    boxes[..., :2] = (first + last) / 2
    boxes[..., 2] = torch.atan2(way[..., 1], way[..., 0])
    boxes[..., 3] += way.norm(dim=-1) / 2
    # So that two who are not there are apart.
    place = torch.arange(people.shape[-2], dtype=torch.float64)
    boxes[..., 1] += torch.where(absent(people), 10.0 * place, 0.0)
    return boxes
