"""Scenes that are put together: a goal, people and boxes, drawn until the goal can be reached."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Sequence

import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_morl.arguments import is_number

from .box_layouts import NO_BOXES, BoxLayout, missing_boxes
from .encounters import solvable_among_people
from .fields import shown
from .people import Draw, Person, nobody, standing, uniform
from .scene_checks import problems_of_people
from .scenes import CLEARANCE, Scene

_MAX_ROUNDS = 200
_SHORTEST_WAY = 0.5


@dataclasses.dataclass(frozen=True)
class Layout:
    """Draws scenes from parts until nothing overlaps and the goal can be reached; the ``sample`` of a scene.

    The robot starts at the origin and the goal lies on the positive x axis, as in all scenes that ship.

    Args:
        people: each draws one person a scene.
        boxes: draws the boxes.
        way: distance from start to goal, metres.
        heading: of the robot at the start, radians.
        start_beside: how far the start lies beside the origin, metres.

    Raises:
        ValueError: without people; :func:`envs.people.nobody` is one who is not there.
    """

    people: tuple[Person, ...] = (standing,)
    boxes: BoxLayout = NO_BOXES
    way: Draw = (6.0, 12.0)
    heading: Draw = (-math.pi, math.pi)
    start_beside: Draw = (0.0, 0.0)

    def __post_init__(self) -> None:
        if not self.people:
            raise ValueError("people must hold at least one, such as envs.people.nobody, got ().")

    @property
    def furthest_goal(self) -> float:
        """Metres from the start."""
        return math.hypot(self.way[1], max(map(abs, self.start_beside)))

    def __call__(self, n: int, robot_radius: float, generator: torch.Generator) -> TensorDict:
        """Scenes ``[n]``, see :class:`Scene`.

        Raises:
            RuntimeError: if none is found for a robot of this size.
        """
        kept: list[TensorDict] = []
        missing = n
        reasons: Counter[str] = Counter()
        for _ in range(_MAX_ROUNDS):
            # Some more than are missing, as some will be thrown away.
            drawn = self._draw(missing + max(missing // 2, 4), robot_radius, generator)
            valid = self._valid(drawn, robot_radius, reasons)
            drawn = drawn[valid]
            drawn = drawn[solvable_among_people(drawn, robot_radius)][:missing]
            kept.append(drawn)
            missing -= len(drawn)
            if not missing:
                return torch.cat(kept)
        reason = reasons.most_common(1)[0][0] if reasons else "goal has no way to it"
        raise RuntimeError(
            f"No scene found in {_MAX_ROUNDS} rounds for a robot of radius {robot_radius} m: {reason}."
        )

    def _draw(self, n: int, robot_radius: float, generator: torch.Generator) -> TensorDict:
        way = uniform((n,), self.way, generator)
        goal = torch.stack((way, torch.zeros_like(way)), dim=-1)
        start = torch.zeros(n, 3, dtype=torch.float64)
        start[:, 1] = uniform((n,), self.start_beside, generator)
        start[:, 2] = uniform((n,), self.heading, generator)
        people = torch.stack([person(way, generator) for person in self.people], dim=1)
        boxes = self.boxes.draw(way, robot_radius, generator)
        fields = {"start": start, "goal": goal, "people": people, "boxes": boxes}
        return TensorDict(fields, batch_size=[n])

    def _valid(self, scenes: TensorDict, robot_radius: float, reasons: Counter[str]) -> Tensor:
        valid = torch.ones(len(scenes), dtype=torch.bool)
        clear = robot_radius + CLEARANCE
        for problem in problems_of_people(scenes, clear, _SHORTEST_WAY):
            bad = problem.scenes()
            if bad.any():
                row = int(bad.to(torch.uint8).argmax())
                reasons[problem.sentence(row)] += int(bad.sum())
                valid &= ~bad
        return valid


@dataclasses.dataclass(frozen=True)
class Mixture:
    """Draws each scene from one of several, by their weights; the ``sample`` of a scene.

    Args:
        scenes: any; who or what a scene has fewer of is not there.
        weights: of them, above zero.

    Raises:
        ValueError: without scenes, or for a weight that is not above zero.
    """

    scenes: tuple[Scene, ...]
    weights: tuple[float, ...]

    def __post_init__(self) -> None:
        if not self.scenes or len(self.scenes) != len(self.weights):
            raise ValueError("mixture must name at least one scene, each with its weight.")
        for scene, weight in zip(self.scenes, self.weights):
            if not (is_number(weight) and weight > 0):
                raise ValueError(
                    f"mixture: the weight of {scene.name!r} must be a number above 0, got "
                    f"{shown(weight)}."
                )

    @property
    def num_boxes(self) -> int:
        return max(scene.num_boxes for scene in self.scenes)

    @property
    def num_people(self) -> int:
        return max(scene.num_people or 1 for scene in self.scenes)

    @property
    def furthest_goal(self) -> float:
        return max(furthest_goal(scene) for scene in self.scenes)

    def __call__(self, n: int, robot_radius: float, generator: torch.Generator) -> TensorDict:
        """Scenes ``[n]``, see :class:`Scene`."""
        weights = torch.tensor(self.weights, dtype=torch.float64)
        which = torch.multinomial(weights, n, replacement=True, generator=generator)
        parts, places = [], []
        for index, scene in enumerate(self.scenes):
            rows = (which == index).nonzero()[:, 0]
            if len(rows):
                drawn = scene.sample(len(rows), robot_radius, generator)
                parts.append(_padded(drawn, scene, self.num_people, self.num_boxes))
                places.append(rows)
        return torch.cat(parts)[torch.cat(places).argsort()]


def furthest_goal(scene: Scene) -> float:
    """How far goals can be in a scene, metres; 12 where it does not say."""
    return getattr(scene.sample, "furthest_goal", 12.0)


def mixture(name: str, weights: Sequence[tuple[Scene, float]]) -> Scene:
    """A scene that is one of several in each episode.

    Examples:
        >>> from envs import SCENES
        >>> both = mixture("both", [(SCENES["static"], 1.0), (SCENES["crossing"], 3.0)])
        >>> both.sample(8, 0.177, torch.Generator().manual_seed(0))["people"].shape
        torch.Size([8, 1, 7])
    """
    sample = Mixture(tuple(one for one, _ in weights), tuple(weight for _, weight in weights))
    fastest = max(scene.human_speed for scene in sample.scenes)
    return Scene(name, sample.num_boxes, sample, fastest, sample.num_people)


def with_people(drawn: TensorDict, human_speed: float) -> Tensor:
    """``people`` [n, P, 7] of scenes that may have a human instead."""
    if "people" in drawn.keys():
        return drawn["people"]
    rest = torch.zeros(len(drawn), 2, dtype=torch.float64)
    rest[:, 0] = human_speed
    return torch.cat((drawn["human"], drawn["human_goal"], rest), dim=-1)[:, None]


def _padded(drawn: TensorDict, scene: Scene, num_people: int, num_boxes: int) -> TensorDict:
    n, people, boxes = len(drawn), with_people(drawn, scene.human_speed), drawn["boxes"]
    more = torch.stack([nobody(drawn["goal"][:, 0], None)] * num_people, dim=1)
    fields = {
        "start": drawn["start"],
        "goal": drawn["goal"],
        "people": torch.cat((people, more[:, people.shape[1] :]), dim=1),
        "boxes": torch.cat((boxes, missing_boxes(n, num_boxes)[:, boxes.shape[1] :]), dim=1),
    }
    return TensorDict(fields, batch_size=[n])
