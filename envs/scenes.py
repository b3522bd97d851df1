"""Scenes as data: where the robot starts, where it must go, the human and the boxes.

A scene is sampled in the frame of its task: the robot starts at the origin and the goal lies on
the positive x axis (observations are relative to the robot, so a global rotation would change
nothing). Rejection sampling is vectorised over scenes and candidates.

Every sampled scene can be solved. In ``static``, ``moving_human`` and ``empty`` all gaps between
obstacles are wider than the robot: obstacles grown by the robot's radius are then disjoint convex
sets, whose complement in the plane is connected, and start and goal lie in it. In ``corridor``
the free cross is connected by construction.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_morl.arguments import check_count, is_number
from torchrl_morl.geometry import box_box_distance, point_box_distance, segment_box_distance

from .fields import is_name, shown

HUMAN_RADIUS = 0.25
"""Radius of the cylinder that stands for the human, metres."""

MOST_BOXES, MOST_PEOPLE = 1_000, 100
"""Of a scene: every pair of them is looked at."""

CLEARANCE = 0.1
"""What every gap leaves beyond the robot's own size, metres."""

_CANDIDATES = 16
_MAX_ROUNDS = 200


@dataclasses.dataclass(frozen=True)
class Scene:
    """A distribution of scenes.

    Args:
        name: what messages, tables and files call it.
        num_boxes: how many boxes each of its scenes has.
        sample: ``sample(n, robot_radius, generator)`` returns a tensordict of batch size ``[n]``,
            float64, with ``start`` [n, 3] (x, y, heading), ``goal`` [n, 2], ``human`` [n, 3],
            ``human_goal`` [n, 2] where the human walks to, and ``boxes`` [n, num_boxes, 5] (x, y,
            yaw, half length, half width).
        human_speed: walking speed of the human, m/s; zero stands still. With ``num_people``, the
            highest of them.
        num_people: how many people each of its scenes has at most. Then ``sample`` returns ``people``
            [n, num_people, 7] in place of ``human`` and ``human_goal``: see :mod:`envs.people`. The
            nearest is the one whose position is reported.

    What ``sample`` returns is checked by the environment, see :func:`envs.scene_checks.checked`.

    Raises:
        ValueError: for a name, a count or a speed that is none.
    """

    name: str
    num_boxes: int
    sample: Callable[[int, float, torch.Generator], TensorDict]
    human_speed: float = 0.0
    num_people: int | None = None

    def __post_init__(self) -> None:
        if not is_name(self.name):
            raise ValueError(f"scene: name must be text of one line, got {shown(self.name)}.")
        check_count(f"Scene {self.name!r}: num_boxes", self.num_boxes, least=0, most=MOST_BOXES)
        if self.num_people is not None:
            check_count(f"Scene {self.name!r}: num_people", self.num_people, most=MOST_PEOPLE)
        if not callable(self.sample):
            raise ValueError(
                f"Scene {self.name!r}: sample must be a function, got {shown(self.sample)}."
            )
        if not (is_number(self.human_speed) and self.human_speed >= 0):
            raise ValueError(
                f"Scene {self.name!r}: human_speed must be a number of m/s, 0 or more, "
                f"got {shown(self.human_speed)}."
            )


def _uniform(shape: tuple[int, ...], low: float, high: float, rng: torch.Generator) -> Tensor:
    return low + (high - low) * torch.rand(shape, generator=rng, dtype=torch.float64)


def _scene(start: Tensor, goal: Tensor, human: Tensor, human_goal: Tensor, boxes: Tensor):
    return TensorDict(
        {
            "start": start,
            "goal": goal,
            "human": human,
            "human_goal": human_goal,
            "boxes": boxes,
        },
        batch_size=start.shape[:1],
    )


def _start_and_goal(n: int, rng: torch.Generator) -> tuple[Tensor, Tensor]:
    """The paper's 6 to 12 m; the robot faces the goal to within 30 degrees."""
    start = torch.zeros(n, 3, dtype=torch.float64)
    start[:, 2] = _uniform((n,), -math.pi / 6, math.pi / 6, rng)
    goal = torch.zeros(n, 2, dtype=torch.float64)
    goal[:, 0] = _uniform((n,), 6.0, 12.0, rng)
    return start, goal


def _place_boxes(
    num_boxes: int,
    goal: Tensor,
    fits: Callable[[Tensor, Tensor], Tensor],
    robot_radius: float,
    rng: torch.Generator,
) -> Tensor:
    """Place boxes one after the other, each where the first of many candidates fits.

    ``fits(candidates [m, c, 5], rows [m])`` says which candidates respect the rest of the scene.
    """
    n = goal.shape[0]
    boxes = torch.zeros(n, num_boxes, 5, dtype=torch.float64)
    passage = 2 * robot_radius + CLEARANCE
    for index in range(num_boxes):
        missing = torch.arange(n)
        for _ in range(_MAX_ROUNDS):
            shape = (missing.numel(), _CANDIDATES)
            candidates = torch.stack(
                (
                    0.5 + _uniform(shape, 0.0, 1.0, rng) * (goal[missing, :1] - 1.0),
                    _uniform(shape, -2.5, 2.5, rng),
                    _uniform(shape, -math.pi, math.pi, rng),
                    _uniform(shape, 0.15, 0.6, rng),
                    _uniform(shape, 0.15, 0.4, rng),
                ),
                dim=-1,
            )
            ok = fits(candidates, missing)
            if index:
                placed = boxes[missing, None, :index]
                gaps = box_box_distance(candidates[:, :, None], placed)
                ok &= (gaps >= passage).all(-1)
            found = ok.any(-1)
            first = ok.to(torch.uint8).argmax(-1)
            chosen = candidates[torch.arange(missing.numel()), first]
            boxes[missing[found], index] = chosen[found]
            missing = missing[~found]
            if not missing.numel():
                break
        else:
            raise RuntimeError(
                f"No place found for box {index} in {missing.numel()} of {n} scenes after "
                f"{_MAX_ROUNDS} rounds: the robot (radius {robot_radius} m) is too large for them."
            )
    return boxes


def _sample_static(n: int, robot_radius: float, rng: torch.Generator) -> TensorDict:
    start, goal = _start_and_goal(n, rng)
    human = torch.zeros(n, 3, dtype=torch.float64)
    human[:, 0] = _uniform((n,), 0.3, 0.7, rng) * goal[:, 0]
    human[:, 1] = _uniform((n,), -0.5, 0.5, rng)
    human[:, 2] = _uniform((n,), -math.pi, math.pi, rng)
    passage = 2 * robot_radius + CLEARANCE

    def fits(box: Tensor, rows: Tensor) -> Tensor:
        return (
            (point_box_distance(start[rows, None, :2], box) >= robot_radius + 0.5)
            & (point_box_distance(goal[rows, None], box) >= robot_radius + CLEARANCE)
            & (point_box_distance(human[rows, None, :2], box) >= HUMAN_RADIUS + passage)
        )

    boxes = _place_boxes(3, goal, fits, robot_radius, rng)
    return _scene(start, goal, human, human[:, :2].clone(), boxes)


def _sample_exploring(n: int, robot_radius: float, rng: torch.Generator) -> TensorDict:
    scene = _sample_static(n, robot_radius, rng)
    shape = (n, _CANDIDATES)
    human = scene["human"][:, None, :2]
    places = human + torch.stack(
        (_uniform(shape, -3.0, 3.0, rng), _uniform(shape, -2.5, 2.5, rng)), dim=-1
    )
    apart = robot_radius + CLEARANCE / 2
    boxes = point_box_distance(places[:, :, None], scene["boxes"][:, None]).amin(-1)
    free = (
        (boxes >= apart)
        & ((places - human).norm(dim=-1) >= HUMAN_RADIUS + apart)
        & ((places - scene["goal"][:, None]).norm(dim=-1) >= 1.0)
    )
    moved = free.any(-1) & (torch.rand(n, generator=rng, dtype=torch.float64) < 0.5)
    first = free.to(torch.uint8).argmax(-1)
    heading = _uniform((n, 1), -math.pi, math.pi, rng)
    start = torch.cat((places[torch.arange(n), first], heading), dim=-1)
    return scene.set("start", torch.where(moved[:, None], start, scene["start"]))


def _sample_moving_human(n: int, robot_radius: float, rng: torch.Generator) -> TensorDict:
    start, goal = _start_and_goal(n, rng)
    offset = _uniform((n,), -0.5, 0.5, rng)
    human = torch.zeros(n, 3, dtype=torch.float64)
    human[:, 0], human[:, 1], human[:, 2] = goal[:, 0], offset, math.pi
    human_goal = torch.stack((start[:, 0], offset), dim=-1)

    def fits(box: Tensor, rows: Tensor) -> Tensor:
        walk = segment_box_distance(human[rows, None, :2], human_goal[rows, None], box)
        return (
            (point_box_distance(start[rows, None, :2], box) >= robot_radius + 0.5)
            & (point_box_distance(goal[rows, None], box) >= robot_radius + CLEARANCE)
            & (walk >= HUMAN_RADIUS + CLEARANCE)
        )

    boxes = _place_boxes(3, goal, fits, robot_radius, rng)
    return _scene(start, goal, human, human_goal, boxes)


def _sample_mixed(n: int, robot_radius: float, rng: torch.Generator) -> TensorDict:
    # Who stands has arrived: the human's goal is where the human is.
    standing = _sample_exploring(n, robot_radius, rng)
    walking = _sample_moving_human(n, robot_radius, rng)
    walks = torch.rand(n, generator=rng, dtype=torch.float64) < 0.5
    return torch.where(walks, walking, standing)


def _sample_empty(n: int, robot_radius: float, rng: torch.Generator) -> TensorDict:
    scene = _sample_static(n, robot_radius, rng)
    return scene.set("boxes", scene["boxes"][:, :0])


def _sample_corridor(n: int, robot_radius: float, rng: torch.Generator) -> TensorDict:
    """Two corridors cross; the robot comes from the left and leaves by one of the other arms."""
    narrowest = 1.2
    if 2 * robot_radius + CLEARANCE > narrowest - HUMAN_RADIUS:
        raise RuntimeError(
            f"The robot (radius {robot_radius} m) is too large to pass the human in a corridor of "
            f"{2 * narrowest} m."
        )
    half_width = _uniform((n,), narrowest, 1.6, rng)
    half_length = 4.0
    centre = half_width + half_length
    signs = torch.tensor([[1.0, 1.0], [1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0]], dtype=torch.float64)
    boxes = torch.zeros(n, 4, 5, dtype=torch.float64)
    boxes[..., :2] = centre[:, None, None] * signs
    boxes[..., 3:] = half_length
    start = torch.zeros(n, 3, dtype=torch.float64)
    start[:, 0] = -_uniform((n,), 4.0, 5.0, rng)
    start[:, 1] = _uniform((n,), -0.3, 0.3, rng)
    start[:, 2] = _uniform((n,), -math.pi / 6, math.pi / 6, rng)
    arm = torch.randint(3, (n,), generator=rng)  # left, straight on, right
    direction = math.pi / 2 * (1 - arm.double())
    reach = _uniform((n,), 4.0, 5.0, rng)
    goal = torch.stack((reach * direction.cos(), reach * direction.sin()), dim=-1)
    human = torch.zeros(n, 3, dtype=torch.float64)
    human[:, :2] = _uniform((n, 2), -0.3, 0.3, rng)
    human[:, 2] = _uniform((n,), -math.pi, math.pi, rng)
    return _scene(start, goal, human, human[:, :2].clone(), boxes)


def _sample_showcase(n: int, robot_radius: float, rng: torch.Generator) -> TensorDict:
    row = TensorDict(
        {
            "start": torch.tensor([0.0, 0.0, 0.0], dtype=torch.float64),
            "goal": torch.tensor([9.0, 0.0], dtype=torch.float64),
            "human": torch.tensor([4.5, 0.0, math.pi], dtype=torch.float64),
            "human_goal": torch.tensor([4.5, 0.0], dtype=torch.float64),
            "boxes": torch.tensor(
                [
                    [1.9, 1.9, 0.5, 0.5, 0.25],
                    [6.9, 1.6, -0.4, 0.4, 0.3],
                    [6.3, -2.3, 0.9, 0.5, 0.2],
                ],
                dtype=torch.float64,
            ),
        }
    )
    return row.expand(n).clone()


STATIC = Scene("static", num_boxes=3, sample=_sample_static)
"""Training: goal 6-12 m away, a standing human near the line to it, three boxes."""

EXPLORING = Scene("exploring", num_boxes=3, sample=_sample_exploring)
"""Training: ``static``, but half of the robots start anywhere around the human, with any heading.

These exploring starts (Sutton and Barto, Reinforcement Learning, section 5.3) show where a policy
gets that has gone wrong: on its own way it is seldom face to face with a human or a box."""

MOVING_HUMAN = Scene("moving_human", num_boxes=3, sample=_sample_moving_human, human_speed=0.5)
"""Evaluation: the human walks from the goal to the start while the robot drives the other way."""

MIXED = Scene("mixed", num_boxes=3, sample=_sample_mixed, human_speed=0.5)
"""Training with moving humans: half of the scenes are as in ``exploring``, half as in
``moving_human``."""

CORRIDOR = Scene("corridor", num_boxes=4, sample=_sample_corridor)
"""Evaluation: an intersection of two corridors with the human in its middle."""

EMPTY = Scene("empty", num_boxes=0, sample=_sample_empty)
"""The human alone."""

SHOWCASE = Scene("showcase", num_boxes=3, sample=_sample_showcase)
"""One fixed scene, for figures."""
