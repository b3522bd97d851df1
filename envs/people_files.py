"""Scenes with any number of people from YAML files and mappings."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping

import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_morl.arguments import is_number

from .encounters import solvable_among_people
from .fields import Fields, is_list, number_hint, shown
from .people import nobody, person
from .scene_checks import Problem, problems_of_company, problems_of_people
from .scene_numbers import FASTEST, METRES, RADIANS, Range, read_boxes, read_numbers
from .scenes import MOST_PEOPLE, Scene

_PERSON_FIELDS = ("at", "goal", "speed", "sets_out")
_LATEST = 60.0  # an episode, seconds

_CANDIDATES = 16
_MAX_ROUNDS = 200
_SHORTEST_WAY = 0.5


def scene_with_people(fields: Fields) -> Scene:
    """A scene whose file has ``people`` in place of one human: see :func:`envs.get_scene`.

    Raises:
        ValueError: for a field that is missing or refused.
    """
    for name in ("human", "human_goal", "human_speed"):
        if name in fields.values:
            raise ValueError(f"{fields.where}: {name} and people exclude each other.")
    start = read_numbers(fields, "start", ("x", "y", "heading"), (METRES, METRES, RADIANS))
    goal = read_numbers(fields, "goal", ("x", "y"), (METRES, METRES))
    given = fields.values["people"]
    if not is_list(given):
        raise fields.refusal("people", "a list of {at, goal, speed, sets_out}", given)
    if len(given) > MOST_PEOPLE:
        raise ValueError(
            f"{fields.where}: people must be at most {MOST_PEOPLE}, got {len(given):,}."
        )
    people = [_person(fields, index, one) for index, one in enumerate(given)]
    boxes = read_boxes(fields)
    fastest = max((numbers[4][1] for numbers in people), default=0.0)
    sampler = PeopleSampler(fields.where, [*start, *goal], people, boxes)
    return Scene(fields.name, len(boxes), sampler, fastest, max(len(people), 1))


def _person(fields: Fields, index: int, given: object) -> list[Range]:
    at = f"people[{index}]"
    if not isinstance(given, Mapping):
        raise fields.refusal(at, "fields {at, goal, speed, sets_out}", given)
    fields.refuse_unknown(given, _PERSON_FIELDS, f" of {at}")
    place = read_numbers(fields, "at", ("x", "y"), (METRES, METRES), given, at)
    pace = given.get("speed", 0.0)
    speed = _amount(fields, f"{at}.speed", pace, FASTEST, "m/s")
    sets_out = _amount(fields, f"{at}.sets_out", given.get("sets_out", 0.0), _LATEST, "seconds")
    if "goal" in given:
        if not speed[1]:
            raise fields.refusal(f"{at}.speed", "above 0 for who has a goal", pace)
        goal = read_numbers(fields, "goal", ("x", "y"), (METRES, METRES), given, at)
        return [*place, *goal, speed, sets_out]
    if speed[1]:
        raise ValueError(
            f"{fields.where}: {at}.goal is missing, where who has a speed of {shown(pace)} m/s walks to: [x, y]."
        )
    if sets_out[1]:
        raise ValueError(
            f"{fields.where}: {at}.sets_out needs a goal to walk to, got {shown(given['sets_out'])}."
        )
    return [*place, *place, speed, sets_out]


def _amount(fields: Fields, title: str, value: object, most: float, unit: str) -> Range:
    ends = tuple(value) if is_list(value) else (value, value)
    if (
        len(ends) != 2
        or not all(is_number(end) for end in ends)
        or not 0 <= ends[0] <= ends[1] <= most
    ):
        allowed = f"a number of {unit} from 0 to {most:g}, or a range [low, high] of two"
        raise fields.refusal(title, allowed, value, number_hint(value))
    return float(ends[0]), float(ends[1])


def _problems(scenes: TensorDict, robot_radius: float) -> Iterator[Problem]:
    yield from problems_of_people(scenes, robot_radius, _SHORTEST_WAY)
    yield from problems_of_company(scenes["people"])


class PeopleSampler:
    """Draws scenes from ranges until they are free and can be solved; the ``sample`` of a scene.

    Args:
        where: what errors call it, a file.
        ends: ranges of start and goal, five.
        people: ranges of x, y, x and y of the goal, speed and when they set out, of each.
        boxes: ranges of the five numbers of each.
    """

    def __init__(
        self, where: str, ends: list[Range], people: list[list[Range]], boxes: list[list[Range]]
    ) -> None:
        self.where, self.num_people, self.num_boxes = where, len(people), len(boxes)
        ranges = [*ends, *(one for each in (*people, *boxes) for one in each)]
        self._low, self._high = torch.tensor(ranges, dtype=torch.float64).T.contiguous()
        self._stand = [each[:2] == each[2:4] and each[4] == (0.0, 0.0) for each in people]

    def __eq__(self, other: object) -> bool:
        return isinstance(other, PeopleSampler) and self.numbers == other.numbers

    def __hash__(self) -> int:
        return hash(self.numbers)

    @property
    def numbers(self) -> tuple[float, ...]:
        """All that it draws from; samplers with the same numbers are equal."""
        return self.num_people, self.num_boxes, *self._low.tolist(), *self._high.tolist()

    def __call__(self, n: int, robot_radius: float, generator: torch.Generator) -> TensorDict:
        """Scenes ``[n]``, see :class:`Scene`.

        Raises:
            ValueError: if the fixed scene is not valid, or none is found.
        """
        if bool((self._low == self._high).all()):
            self._check_fixed(robot_radius)
            return self._scenes(self._low.expand(n, -1))
        kept: list[TensorDict] = []
        missing, reasons = n, Counter[str]()
        for _ in range(_MAX_ROUNDS):
            shape = (missing * _CANDIDATES, len(self._low))
            share = torch.rand(shape, generator=generator, dtype=torch.float64)
            drawn = self._scenes(self._low + (self._high - self._low) * share)
            valid = torch.ones(len(drawn), dtype=torch.bool)
            for problem in _problems(drawn, robot_radius):
                bad = problem.scenes()
                if bad.any():
                    row = int(bad.to(torch.uint8).argmax())
                    reasons[problem.sentence(row)] += int((bad & valid).sum())
                    valid &= ~bad
            drawn = drawn[valid][:missing]
            solved = solvable_among_people(drawn, robot_radius)
            reasons["goal has no way to it that is safe from people who walk"] += int(
                (~solved).sum()
            )
            kept.append(drawn[solved])
            missing -= int(solved.sum())
            if not missing:
                return torch.cat(kept)
            if missing == n and len(kept) >= 8:
                break
        raise ValueError(
            f"{self.where}: no scene found for a robot of radius {robot_radius:g} m, after many "
            f"draws: {reasons.most_common(1)[0][0]}. Widen the ranges."
        )

    def check(self, robot_radius: float) -> None:
        """Draw one scene.

        Raises:
            ValueError: as in a call.
        """
        self(1, robot_radius, torch.Generator().manual_seed(0))

    def _check_fixed(self, robot_radius: float) -> None:
        scene = self._scenes(self._low[None])
        for problem in _problems(scene, robot_radius):
            if problem.scenes().any():
                raise ValueError(f"{self.where}: {problem.sentence_with_value(0)}.")
        if not solvable_among_people(scene, robot_radius).all():
            raise ValueError(
                f"{self.where}: goal must have a way to it for a robot of radius {robot_radius:g} m "
                f"that is safe from people who walk, got {scene['goal'][0].tolist()}."
            )

    def _scenes(self, numbers: Tensor) -> TensorDict:
        start, goal, people, boxes = numbers.split(
            (3, 2, 6 * self.num_people, 5 * self.num_boxes), -1
        )
        rows = [
            person((x, y), (x, y) if stands else (goal_x, goal_y), speed, sets_out)
            for (x, y, goal_x, goal_y, speed, sets_out), stands in zip(
                (each.unbind(-1) for each in people.split(6, -1)), self._stand
            )
        ]
        fields = {
            "start": start,
            "goal": goal,
            "people": torch.stack(rows or [nobody(goal[:, 0], None)], dim=1),
            "boxes": boxes.unflatten(-1, (self.num_boxes, 5)),
        }
        return TensorDict({name: one.clone() for name, one in fields.items()}, [len(numbers)])
