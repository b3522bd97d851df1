"""Scenes from YAML files and mappings: one fixed scene, or ranges that every episode draws from."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_morl.arguments import is_number

from .catalogue import SCENES
from .fields import Fields, is_description, is_list, number_hint, shown
from .scene_checks import problems, solvable
from .scenes import Scene

_FIELDS = ("name", "start", "goal", "human", "human_goal", "human_speed", "boxes")
_BOX_FIELDS = ("at", "yaw", "size")

# Coordinates and sizes beyond are millimetres by mistake, angles beyond are degrees.
_FARTHEST = 100.0
_FASTEST = 3.0
_METRES = (-_FARTHEST, _FARTHEST)
_RADIANS = (-2 * math.pi, 2 * math.pi)

_CANDIDATES = 16
_MAX_ROUNDS = 200
# The search for a way takes milliseconds: so many scenes without one are enough.
_MAX_UNSOLVABLE = 256
# Start and goal are at least so far apart, metres: more than the radius of the goal.
_SHORTEST_WAY = 0.5

Range = tuple[float, float]


def get_scene(scene: str | Path | Mapping[str, Any] | Scene) -> Scene:
    """Return the scene of that name or description, or the scene itself.

    Args:
        scene: a name from :data:`SCENES`, the path of a YAML file (``.yaml``, ``.yml``), a mapping of
            the same fields, or a :class:`Scene`. The fields are ``start`` (x, y, heading), ``goal``
            (x, y), ``human`` (x, y, and a heading if you like) and ``boxes``, a list of ``at`` (x, y),
            ``yaw`` and ``size`` (length, width); where the human walks, ``human_goal`` (x, y) and
            ``human_speed``. Metres, radians, m/s. A range [low, high] in place of a number is drawn from
            in every episode.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if no scene has that name, and for a field that does not exist or is refused.

    Examples:
        A person somewhere beside a wall.

        >>> import torch
        >>> wall = {"at": [4.0, 2.0], "size": [0.2, 2.0]}
        >>> scene = get_scene(
        ...     {"start": [0, 0, 0], "goal": [8, 0], "human": [[3, 5], -0.5], "boxes": [wall]}
        ... )
        >>> generator = torch.Generator().manual_seed(0)
        >>> scene.sample(64, 0.177, generator)["human"].shape
        torch.Size([64, 3])
    """
    if isinstance(scene, Scene):
        return scene
    if isinstance(scene, str) and scene in SCENES:
        return SCENES[scene]
    if not is_description(scene):
        raise ValueError(
            f"Unknown scene {shown(scene)}: choose one of {sorted(SCENES)}, the path of a .yaml "
            "file, a mapping of fields, or an envs.Scene."
        )
    return scene_from(scene)


def scene_from(source: str | Path | Mapping[str, Any]) -> Scene:
    """A scene from the path of a YAML file, or from a mapping of the same fields.

    See :func:`envs.get_scene`, which calls it.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: for a field that does not exist, is missing or is refused.
    """
    fields = Fields(source, "scene", _FIELDS)
    start = _numbers(fields, "start", ("x", "y", "heading"), (_METRES, _METRES, _RADIANS))
    goal = _numbers(fields, "goal", ("x", "y"), (_METRES, _METRES))
    human, heading = _human(fields)
    speed = fields.values.get("human_speed", 0.0)
    if not (is_number(speed) and 0 <= speed <= _FASTEST):
        allowed = f"a number of m/s from 0 to {_FASTEST:g}"
        raise fields.refusal("human_speed", allowed, speed, number_hint(speed))
    target = None
    if speed:
        target = _numbers(fields, "human_goal", ("x", "y"), (_METRES, _METRES))
    elif "human_goal" in fields.values:
        raise ValueError(f"{fields.where}: human_goal needs human_speed, in m/s above 0.")
    boxes = _boxes(fields)
    sampler = SceneSampler(fields.where, start, goal, human, boxes, heading=heading, target=target)
    return Scene(fields.name, len(boxes), sampler, human_speed=float(speed))


def _human(fields: Fields) -> tuple[list[Range], Range | None]:
    """Place and heading of the human; ``None`` for where they walk to."""
    human = fields.values.get("human")
    if human is None:
        raise ValueError(
            f"{fields.where}: human is missing: every scene has one. Let them stand aside, "
            "such as human: [0, 4]."
        )
    if is_list(human) and len(human) == 3:
        ranges = _numbers(fields, "human", ("x", "y", "heading"), (_METRES, _METRES, _RADIANS))
        return ranges[:2], ranges[2]
    return _numbers(fields, "human", ("x", "y"), (_METRES, _METRES)), None


def _boxes(fields: Fields) -> list[list[Range]]:
    """The five numbers of each box as in :class:`Scene`, with half lengths and widths."""
    boxes = fields.values.get("boxes", [])
    if not is_list(boxes):
        raise fields.refusal("boxes", "a list of {at, yaw, size}", boxes)
    out = []
    for index, box in enumerate(boxes):
        at = f"boxes[{index}]"
        if not isinstance(box, Mapping):
            raise fields.refusal(at, "fields {at, yaw, size}", box)
        fields.refuse_unknown(box, _BOX_FIELDS, f" of {at}")
        x, y = _numbers(fields, "at", ("x", "y"), (_METRES, _METRES), box, at)
        yaw = _number(fields, f"{at}.yaw", box.get("yaw", 0.0), _RADIANS, "radians")
        limits = ((0.0, _FARTHEST),) * 2
        length, width = _numbers(fields, "size", ("length", "width"), limits, box, at)
        length, width = ((low / 2, high / 2) for low, high in (length, width))
        out.append([x, y, yaw, length, width])
        if out[-1] in out[:-1] and all(low == high for low, high in out[-1]):
            raise ValueError(f"{fields.where}: {at} is boxes[{out.index(out[-1])}] once more.")
    return out


def _numbers(
    fields: Fields,
    field: str,
    names: tuple[str, ...],
    limits: tuple[Range, ...],
    values: Mapping[str, Any] | None = None,
    at: str = "",
) -> list[Range]:
    values = fields.values if values is None else values
    title = f"{at}.{field}" if at else field
    what = f"[{', '.join(names)}], each a number or a range [low, high]"
    if field not in values:
        raise ValueError(f"{fields.where}: {title} is missing: {what}.")
    value = values[field]
    if not is_list(value) or len(value) != len(names):
        raise fields.refusal(title, what, value)
    return [
        _number(
            fields, f"{name} of {title}", one, ends, "radians" if ends is _RADIANS else "metres"
        )
        for name, one, ends in zip(names, value, limits)
    ]


def _number(fields: Fields, title: str, value: Any, limits: Range, unit: str) -> Range:
    """A number, or a range of two."""
    low, high = limits
    ends = tuple(value) if is_list(value) else (value, value)
    sizes = low == 0
    allowed = f"a number of {unit} {'above 0' if sizes else f'from {low:.4g}'}"
    allowed += f"{' and at most' if sizes else ' to'} {high:.4g}, or a range [low, high] of two"
    bad = next((end for end in ends if not is_number(end)), None)
    if len(ends) != 2 or bad is not None:
        raise fields.refusal(title, allowed, value, number_hint(bad))
    if not all(low <= end <= high and (end > 0 or not sizes) for end in ends):
        degrees = unit == "radians" and all(abs(end) <= 360 for end in ends)
        hint = f"{ends[1]:g} degrees are {math.radians(ends[1]):.4g}." if degrees else ""
        raise fields.refusal(title, allowed, value, hint)
    if ends[0] > ends[1]:
        raise fields.refusal(title, "a range [low, high] in ascending order", value)
    return float(ends[0]), float(ends[1])


class SceneSampler:
    """Draws scenes from ranges until they are free and can be solved; the ``sample`` of a scene.

    Args:
        where: what errors call it, a file.
        start: ranges of x, y and heading.
        goal: ranges of x and y.
        human: ranges of x and y.
        boxes: ranges of the five numbers of each.

    Keyword Args:
        heading: range of the human's; ``None``: where they walk to, or along x.
        target: ranges of where the human walks to; ``None`` where they stand.
    """

    def __init__(
        self,
        where: str,
        start: list[Range],
        goal: list[Range],
        human: list[Range],
        boxes: list[list[Range]],
        *,
        heading: Range | None,
        target: list[Range] | None,
    ) -> None:
        self.where = where
        self.num_boxes = len(boxes)
        self.walks, self.ahead = target is not None, heading is None
        ranges = [*start, *goal, *human, heading or (0.0, 0.0), *(target or human)]
        ranges += [numbers for box in boxes for numbers in box]
        self._low, self._high = torch.tensor(ranges, dtype=torch.float64).T.contiguous()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, SceneSampler) and self._key() == other._key()

    def __hash__(self) -> int:
        return hash(self._key())

    def _key(self) -> tuple[Any, ...]:
        return self.walks, self.ahead, *self._low.tolist(), *self._high.tolist()

    @property
    def is_fixed(self) -> bool:
        """Whether all scenes are one."""
        return bool((self._low == self._high).all())

    def __call__(self, n: int, robot_radius: float, generator: torch.Generator) -> TensorDict:
        """Scenes ``[n]``, see :class:`Scene`.

        Raises:
            ValueError: if the fixed scene is not valid, or none is found.
        """
        if self.is_fixed:
            self._check_fixed(robot_radius)
            return self._scenes(self._low.expand(n, -1))
        drawn = torch.zeros(n, len(self._low), dtype=torch.float64)
        missing, reasons, unsolvable = torch.arange(n), Counter(), 0
        for _ in range(_MAX_ROUNDS):
            shape = (len(missing), _CANDIDATES, len(self._low))
            share = torch.rand(shape, generator=generator, dtype=torch.float64)
            candidates = self._low + (self._high - self._low) * share
            valid = self._valid(candidates.flatten(0, 1), robot_radius, reasons)
            valid = valid.unflatten(0, shape[:2])
            chosen = candidates[torch.arange(len(missing)), valid.to(torch.uint8).argmax(-1)]
            found = valid.any(-1)
            rows = found.nonzero()[:, 0]
            scenes = self._scenes(chosen[rows])
            solved = solvable(scenes, robot_radius, walks=self.walks, exact=False)
            found[rows] = solved
            drawn[missing[found]] = chosen[found]
            missing = missing[~found]
            if not len(missing):
                return self._scenes(drawn)
            unsolvable += int((~solved).sum())
            reasons["goal has no way to it past boxes and human"] += int((~solved).sum())
            if unsolvable >= _MAX_UNSOLVABLE and len(missing) == n:
                break
        reason, times = reasons.most_common(1)[0]
        raise ValueError(
            f"{self.where}: no scene found for a robot of radius {robot_radius:g} m, after many "
            f"draws. {times:,} times: {reason}. Widen the ranges."
        )

    def check(self, robot_radius: float) -> None:
        """Draw one scene.

        Raises:
            ValueError: as in a call.
        """
        self(1, robot_radius, torch.Generator().manual_seed(0))

    def _check_fixed(self, robot_radius: float) -> None:
        scene = self._scenes(self._low[None])
        for problem in problems(scene, robot_radius, _SHORTEST_WAY, walks=self.walks):
            if problem.scenes().any():
                raise ValueError(f"{self.where}: {problem.sentence_with_value(0, scene)}.")
        if not solvable(scene, robot_radius, walks=self.walks).all():
            raise ValueError(
                f"{self.where}: goal must have a way to it for a robot of radius "
                f"{robot_radius:g} m, past boxes and a human who stands."
            )

    def _valid(self, numbers: Tensor, robot_radius: float, reasons: Counter) -> Tensor:
        """Which of the scenes are free of problems, ``[m]``; counts the reasons of the others."""
        valid = torch.ones(len(numbers), dtype=torch.bool)
        for problem in problems(
            self._scenes(numbers), robot_radius, _SHORTEST_WAY, walks=self.walks
        ):
            bad = problem.scenes()
            if bad.any():
                row = int(bad.to(torch.uint8).argmax())
                reasons[problem.sentence(row)] += int((bad & valid).sum())
                valid &= ~bad
        return valid

    def _scenes(self, numbers: Tensor) -> TensorDict:
        start, goal, human, human_goal, boxes = numbers.split((3, 2, 3, 2, 5 * self.num_boxes), -1)
        human = human.clone()
        if self.ahead and self.walks:
            way = human_goal - human[:, :2]
            human[:, 2] = torch.atan2(way[:, 1], way[:, 0])
        if not self.walks:
            human_goal = human[:, :2]
        values = {"start": start, "goal": goal, "human": human, "human_goal": human_goal}
        values = {key: value.clone() for key, value in values.items()}
        boxes = boxes.unflatten(-1, (self.num_boxes, 5)).clone()
        return TensorDict({**values, "boxes": boxes}, batch_size=numbers.shape[:1])
