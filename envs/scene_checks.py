"""What is wrong with scenes: said in one line, before an episode begins in them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_morl.evaluation import shortest_path_length
from torchrl_morl.geometry import (
    box_box_distance,
    box_corners,
    point_box_distance,
    rotate,
    segment_box_distance,
)

from .people import PERSON
from .scenes import HUMAN_RADIUS, Scene
from .ways import leads_around

# Where a walking human is not in the way, metres.
_FAR = 1e4

# Scenes whose lines between corners are looked at together, and how much nearer counts as touching.
_CHUNK = 32
_TOLERANCE = 1e-6


class Problem(NamedTuple):
    """Something that no scene may have."""

    field: str
    reason: str
    """What it must be instead; ``{index}`` stands for the number of the box or the person."""
    where: Tensor
    """Which scenes have it, bool ``[n]``, or which of their boxes or people, ``[n, B]``."""
    values: Tensor
    """What the field is, ``[n, ...]``, or ``[n, B, ...]`` of a field with a number in its name."""

    def scenes(self) -> Tensor:
        """Which scenes have it, ``[n]``."""
        return self.where if self.where.ndim == 1 else self.where.any(-1)

    def sentence(self, row: int) -> str:
        """Field and reason in the scene ``row``, which has it."""
        return f"{self.field} {self.reason}".format(index=self._index(row))

    def sentence_with_value(self, row: int) -> str:
        """The same, and what the field is there."""
        value = self.values[row]
        if "{index}" in self.field:
            value = value[self._index(row)]
        return f"{self.sentence(row)}, got {[round(one, 3) for one in value.flatten().tolist()]}"

    def _index(self, row: int) -> int:
        return int(self.where[row].to(torch.uint8).argmax()) if self.where.ndim > 1 else 0


def checked(scenes: TensorDictBase, scene: Scene, n: int, robot_radius: float, goal_radius: float):
    """The fields of :class:`Scene` in what its ``sample`` returned, once they are found to be right.

    Args:
        scenes: what it returned.
        scene: whose name messages bear.
        n: how many scenes were asked for.
        robot_radius: metres.
        goal_radius: distance from the goal at which it is reached, metres.

    Returns:
        A mapping of the fields to tensors ``[n, ...]``.

    Raises:
        ValueError: in one line, for a missing field, a shape, a type, a number that is not finite, a
            robot, goal or human inside something, or a start that is at the goal.
    """
    shapes = {"start": (n, 3), "goal": (n, 2), "boxes": (n, scene.num_boxes, 5)}
    if scene.num_people is None:
        shapes |= {"human": (n, 3), "human_goal": (n, 2)}
    else:
        shapes["people"] = (n, scene.num_people, len(PERSON))
    if not isinstance(scenes, (TensorDictBase, Mapping)):
        raise ValueError(
            f"Scene {scene.name!r}: its sample must return a tensordict, got {type(scenes).__name__}."
        )
    fields: dict[str, Tensor] = {}
    for field, shape in shapes.items():
        value = scenes.get(field, None)
        if value is None:
            raise ValueError(f"Scene {scene.name!r}: its sample returns no {field!r}.")
        fields[field] = value
        _check_tensor(f"Scene {scene.name!r}: {field}", value, shape, scene.num_boxes)
    for problem in _all_problems(fields, scene, robot_radius, goal_radius):
        bad = problem.scenes()
        if bad.any():
            row = int(bad.to(torch.uint8).argmax())
            sentence = problem.sentence_with_value(row)
            raise ValueError(f"Scene {scene.name!r}, scene {row} of {n}: {sentence}.")
    return fields


def _all_problems(
    fields: dict[str, Tensor], scene: Scene, robot_radius: float, goal_radius: float
) -> Iterator[Problem]:
    if scene.num_people is None:
        yield from problems(fields, robot_radius, goal_radius, walks=scene.human_speed > 0)
    else:
        yield from problems_of_people(fields, robot_radius, goal_radius)


def problems_of_people(
    scenes: Mapping[str, Tensor] | TensorDictBase, robot_radius: float, shortest_way: float
) -> Iterator[Problem]:
    """:func:`problems` of scenes with ``people`` [n, P, 7] in place of one human: of each of them.

    Args:
        scenes: ``start``, ``goal``, ``boxes`` and ``people``.
        robot_radius: metres.
        shortest_way: what is too short from start to goal, metres.
    """
    people = scenes["people"]
    yield Problem("people", "must be finite", ~people.isfinite().flatten(1).all(-1), people)
    timing = people[..., 5:]
    negative = (timing < 0).flatten(1).any(-1)
    yield Problem("people", "must have a speed and a time of 0 or more", negative, people)
    for index, one in enumerate(people.unbind(1)):
        each = {name: scenes[name] for name in ("start", "goal", "boxes")}
        each |= {"human": one[:, :3], "human_goal": one[:, 3:5]}
        name = f"people[{index}]"
        yield from problems(each, robot_radius, shortest_way, walks=True, name=name)


def problems_of_company(people: Tensor) -> Iterator[Problem]:
    """People who stand in each other at the start; on their ways they may meet.

    Args:
        people: ``[n, P, 7]``.
    """
    apart = 2 * HUMAN_RADIUS
    for index in range(1, people.shape[1]):
        place = people[:, index, :2]
        near = (people[:, :index, :2] - place[:, None]).norm(dim=-1) <= apart
        reason = f"must be farther from people[{{index}}] than both radii, {apart:g} m"
        yield Problem(f"people[{index}]", reason, near, place)


def _check_tensor(name: str, value: Any, shape: tuple[int, ...], num_boxes: int) -> None:
    if not isinstance(value, Tensor):
        raise ValueError(f"{name} must be a tensor, got {type(value).__name__}.")
    if value.shape != shape:
        why = f" of its {num_boxes} boxes (num_boxes)" if len(shape) == 3 else ""
        raise ValueError(f"{name} must be {list(shape)}{why}, got {list(value.shape)}.")
    if value.dtype != torch.float64:
        raise ValueError(f"{name} must be float64, got {value.dtype}: give it dtype=torch.float64.")
    if value.device.type != "cpu" or value.requires_grad:
        raise ValueError(f"{name} must be on the CPU and without gradient, got {value.device}.")


def problems(
    scenes: Mapping[str, Tensor] | TensorDictBase,
    robot_radius: float,
    shortest_way: float,
    *,
    walks: bool,
    name: str = "human",
) -> Iterator[Problem]:
    """Everything that can be wrong with the numbers of scenes.

    Args:
        scenes: the fields of :class:`Scene`, ``[n, ...]``.
        robot_radius: metres.
        shortest_way: what is too short from start to goal, metres.

    Keyword Args:
        walks: whether humans walk to their goals.
        name: what messages call the human.
    """
    human_goal = "human_goal" if name == "human" else f"{name}.goal"
    fields = {"start": "start", "goal": "goal", name: "human", human_goal: "human_goal"}
    for title, field in fields.items():
        value = scenes[field]
        yield Problem(title, "must be finite", ~value.isfinite().all(-1), value)
    boxes = scenes["boxes"]
    yield Problem("boxes[{index}]", "must be finite", ~boxes.isfinite().all(-1), boxes)
    no_size = ~(boxes[..., 3:] > 0).all(-1)
    yield Problem("boxes[{index}]", "must have a size above 0", no_size, boxes)
    start, goal, human = scenes["start"][:, :2], scenes["goal"], scenes["human"][:, :2]
    way = (goal - start).norm(dim=-1)
    far = f"must be more than {shortest_way:g} m away from the start"
    yield Problem("goal", far, way <= shortest_way, goal)
    places = torch.stack((start, goal, human), dim=1)
    gaps = point_box_distance(places[:, :, None], boxes[:, None])
    beside = f"must be farther from boxes[{{index}}] than the robot's radius of {robot_radius:g} m"
    yield Problem("start", beside, gaps[:, 0] <= robot_radius, scenes["start"])
    yield Problem("goal", beside, gaps[:, 1] <= robot_radius, goal)
    yield Problem(
        name,
        f"must be farther from boxes[{{index}}] than the human's radius of {HUMAN_RADIUS:g} m",
        gaps[:, 2] <= HUMAN_RADIUS,
        scenes["human"] if name == "human" else human,
    )
    apart = robot_radius + HUMAN_RADIUS
    somebody = "the human" if name == "human" else name
    alone = f"must be farther from {somebody} than both radii, {apart:g} m"
    yield Problem("start", alone, (start - human).norm(dim=-1) <= apart, scenes["start"])
    stays = _stays(scenes, walks=walks)
    yield Problem("goal", alone, stays & ((goal - human).norm(dim=-1) <= apart), goal)
    walk = human[:, None], scenes["human_goal"][:, None], boxes
    if walks and _may_come_near(*walk, HUMAN_RADIUS).any():
        yield Problem(
            human_goal,
            f"must be reached on a line that keeps {HUMAN_RADIUS:g} m from boxes[{{index}}]",
            segment_box_distance(*walk) <= HUMAN_RADIUS,
            scenes["human_goal"],
        )


def _stays(scenes: Mapping[str, Tensor] | TensorDictBase, *, walks: bool) -> Tensor:
    """Which humans stand, bool ``[n]``: those at their goals do, where the others walk."""
    human = scenes["human"][:, :2]
    if not walks:
        return torch.ones(len(human), dtype=torch.bool)
    return (scenes["human_goal"] == human).all(-1)


def _may_come_near(start: Tensor, end: Tensor, box: Tensor, distance: float) -> Tensor:
    """Which segments meet boxes that are so much larger to all sides, bool.

    A fifth of the time of their distance, and never ``False`` where that is smaller.
    """
    origin = rotate(start - box[..., :2], -box[..., 2])
    way = rotate(end - box[..., :2], -box[..., 2]) - origin
    way = way.masked_fill(way == 0, 1e-12)
    half = box[..., 3:] + distance
    one, other = (-half - origin) / way, (half - origin) / way
    enters, leaves = torch.minimum(one, other).amax(-1), torch.maximum(one, other).amin(-1)
    return (enters <= leaves) & (leaves >= 0) & (enters <= 1)


def solvable(
    scenes: Mapping[str, Tensor] | TensorDictBase,
    robot_radius: float,
    *,
    walks: bool,
    exact: bool = True,
) -> Tensor:
    """In which scenes the robot finds a way to the goal past boxes and a standing human, bool ``[n]``.

    Args:
        scenes: the fields of :class:`Scene`, ``[n, ...]``, without :func:`problems`.
        robot_radius: metres.

    Keyword Args:
        walks: whether humans walk, and leave the way free sooner or later.
        exact: look for ways that are round where nothing else fits, in ten times the time; "yes" is
            proof in any case.
    """
    start, goal, boxes = scenes["start"][:, :2], scenes["goal"], scenes["boxes"]
    human = torch.zeros(len(start), 1, 5, dtype=torch.float64)
    human[:, 0, :2] = scenes["human"][:, :2]
    human[~_stays(scenes, walks=walks), :, :2] = _FAR
    obstacles = torch.cat((boxes, human), dim=1)
    grown = torch.full(obstacles.shape[:-1], robot_radius, dtype=torch.float64)
    grown[:, -1] += HUMAN_RADIUS
    free = _free_way(start, goal, obstacles, grown)
    unsure = ~free
    if exact and unsure.any():
        length = shortest_path_length(
            start[unsure],
            goal[unsure],
            boxes[unsure],
            radius=robot_radius,
            human=human[unsure, 0],
            human_radius=HUMAN_RADIUS,
        )
        free[unsure] = length.isfinite()
    return free


def way_exists(start: Tensor, goal: Tensor, obstacles: Tensor, grown: Tensor) -> Tensor:
    """Whether something small finds a way past boxes that are grown, bool ``[n]``; "yes" is proof.

    Args:
        start: ``[n, 2]``, metres.
        goal: ``[n, 2]``.
        obstacles: ``[n, M, 5]``: x, y, yaw, half length, half width.
        grown: ``[n, M]``: by how much each is larger to all sides, metres.
    """
    ends = torch.stack((start, goal), dim=1)
    outside = point_box_distance(ends[:, :, None], obstacles[:, None]) > grown[:, None]
    free = outside.all(-1).all(-1)
    rows = free.nonzero()[:, 0]
    free[rows] = _free_way(start[rows], goal[rows], obstacles[rows], grown[rows])
    return free


def _free_way(start: Tensor, goal: Tensor, obstacles: Tensor, grown: Tensor) -> Tensor:
    """The same between ends that are outside of all grown obstacles."""
    # Boxes that are grown squarely take a hundredth of the time and settle most; the rest is looked at again.
    larger = torch.cat((obstacles[..., :3], obstacles[..., 3:] + grown[..., None]), dim=-1)
    free = torch.from_numpy(
        leads_around(*(one.double().contiguous().numpy() for one in (start, goal, larger)))
    )
    rows = (~free).nonzero()[:, 0]
    if len(rows):
        free[rows] = _round_way(start[rows], goal[rows], obstacles[rows], grown[rows])
    return free


def _round_way(start: Tensor, goal: Tensor, obstacles: Tensor, grown: Tensor) -> Tensor:
    """The same around obstacles that are grown with round corners, and so smaller."""
    free = (segment_box_distance(start[:, None], goal[:, None], obstacles) > grown).all(-1)
    # Convex obstacles that stay disjoint when grown leave a connected plane.
    first, second = torch.triu_indices(obstacles.shape[1], obstacles.shape[1], offset=1)
    gaps = box_box_distance(obstacles[:, first], obstacles[:, second])
    free |= (gaps > grown[:, first] + grown[:, second]).all(-1)
    for rows in (~free).nonzero()[:, 0].split(_CHUNK):
        free[rows] = _around_corners(start[rows], goal[rows], obstacles[rows], grown[rows])
    return free


def _around_corners(start: Tensor, goal: Tensor, obstacles: Tensor, grown: Tensor) -> Tensor:
    """Whether straight lines between the corners of grown boxes lead to the goal, bool ``[n]``.

    :func:`shortest_path_length` rounds the corners, and takes ten times as long.
    """
    larger = torch.cat((obstacles[..., :3], obstacles[..., 3:] + grown[..., None]), dim=-1)
    nodes = torch.cat((start[:, None], goal[:, None], box_corners(larger).flatten(1, 2)), dim=1)
    first, second = torch.triu_indices(nodes.shape[1], nodes.shape[1], offset=1)
    ends = nodes[:, first, None], nodes[:, second, None]
    free = (segment_box_distance(*ends, obstacles[:, None]) >= grown[:, None] - _TOLERANCE).all(-1)
    seen = torch.eye(nodes.shape[1]).repeat(len(nodes), 1, 1)
    seen[:, first, second] = seen[:, second, first] = free.float()
    reached = seen[:, :1]
    for _ in range(nodes.shape[1]):
        reached = (reached @ seen).clamp_max(1.0)
    return reached[:, 0, 1] > 0
