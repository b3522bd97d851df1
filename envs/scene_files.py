"""Scenes from YAML files and mappings: one fixed scene, or ranges that every episode draws from."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_morl.arguments import is_number

from .catalogue import SCENES
from .fields import Fields, is_description, is_list, number_hint, portable, shown
from .layouts import mixture
from .people_files import scene_with_people
from .scene_checks import problems, solvable
from .scene_numbers import FASTEST, METRES, RADIANS, Range, read_boxes, read_numbers
from .scenes import Scene

_FIELDS = (
    "name",
    "start",
    "goal",
    "human",
    "human_goal",
    "human_speed",
    "people",
    "boxes",
    "mixture",
)
_ENTRY_FIELDS = ("weight", "scene")

_CANDIDATES = 16
_MAX_ROUNDS = 200
# The search for a way takes milliseconds: so many scenes without one are enough.
_MAX_UNSOLVABLE = 256
# Start and goal are at least so far apart, metres: more than the radius of the goal.
_SHORTEST_WAY = 0.5


def get_scene(scene: str | Path | Mapping[str, Any] | Scene) -> Scene:
    """Return the scene of that name or description, or the scene itself.

    Args:
        scene: a name from :data:`SCENES`, the path of a YAML file (``.yaml``, ``.yml``), a mapping of
            the same fields, or a :class:`Scene`. The fields are ``start`` (x, y, heading), ``goal``
            (x, y), ``human`` (x, y, and a heading if you like) and ``boxes``, a list of ``at`` (x, y),
            ``yaw`` and ``size`` (length, width); where the human walks, ``human_goal`` (x, y) and
            ``human_speed``; or ``people`` in place of the human, and nothing but a ``mixture`` of names
            and weights for one of several scenes. Metres, radians, m/s. A range [low, high] in place of a number is drawn from
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
    return _scene_from(source, ())


def _scene_from(source: str | Path | Mapping[str, Any], within: tuple[Path, ...]) -> Scene:
    """The same, of a file that stands in the mixtures of others."""
    file = None if isinstance(source, Mapping) else Path(source).resolve()
    if file in within:
        raise ValueError(f"{source} is a mixture of itself: leave it out.")
    fields = Fields(source, "scene", _FIELDS)
    if "mixture" in fields.values:
        return _mixture(fields, within if file is None else (*within, file))
    if "people" in fields.values:
        return scene_with_people(fields)
    start = read_numbers(fields, "start", ("x", "y", "heading"), (METRES, METRES, RADIANS))
    goal = read_numbers(fields, "goal", ("x", "y"), (METRES, METRES))
    human, heading = _human(fields)
    speed = fields.values.get("human_speed", 0.0)
    if not (is_number(speed) and 0 <= speed <= FASTEST):
        allowed = f"a number of m/s from 0 to {FASTEST:g}"
        raise fields.refusal("human_speed", allowed, speed, number_hint(speed))
    target = None
    if speed:
        target = read_numbers(fields, "human_goal", ("x", "y"), (METRES, METRES))
    elif "human_goal" in fields.values:
        raise ValueError(f"{fields.where}: human_goal needs human_speed, in m/s above 0.")
    boxes = read_boxes(fields)
    sampler = SceneSampler(fields.where, start, goal, human, boxes, heading=heading, target=target)
    return Scene(fields.name, len(boxes), sampler, human_speed=float(speed))


def _mixture(fields: Fields, within: tuple[Path, ...]) -> Scene:
    """One of several in each episode; files are looked for beside the one that names them."""
    others = [name for name in fields.values if name not in ("name", "mixture")]
    if others:
        raise ValueError(f"{fields.where}: {others[0]} and mixture exclude each other.")
    weights = fields.values["mixture"]
    if not isinstance(weights, Mapping) or not weights:
        raise fields.refusal("mixture", "names of scenes or .yaml files with weights", weights)
    scenes = []
    for name, given in weights.items():
        at = f"mixture.{name}"
        source, weight = name, given
        if isinstance(given, Mapping):
            fields.refuse_unknown(given, _ENTRY_FIELDS, f" of {at}")
            source, weight, at = given.get("scene", name), given.get("weight"), f"{at}.weight"
        if not (is_number(weight) and weight > 0):
            raise fields.refusal(at, "a weight above 0", weight, number_hint(weight))
        try:
            if not is_description(source):
                scene = get_scene(source)
            elif isinstance(source, Mapping):
                scene = _scene_from({"name": str(name), **source}, within)
            else:
                scene = _scene_from(within[-1].parent / source if within else source, within)
            scenes.append((scene, float(weight)))
        except (OSError, ValueError) as error:
            raise ValueError(f"{fields.where}: mixture: {error}") from error
    return mixture(fields.name, scenes)


def portable_scene(source: Any) -> Any:
    """What a card can keep of a scene: the fields of a file, also of those that a mixture names.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: for a file that is not YAML, or a mixture of itself.

    Examples:
        >>> portable_scene({"mixture": {"static": 3}})
        {'mixture': {'static': 3}}
    """
    return _portable(source, Path(), ())


def _portable(source: Any, folder: Path, within: tuple[Path, ...]) -> Any:
    """The same of what stands in a file of that folder, which stands in the mixtures of others."""
    if not is_description(source):
        return source
    if not isinstance(source, Mapping):
        file = (folder / source).resolve()
        if file in within:
            raise ValueError(f"{source} is a mixture of itself: leave it out.")
        source, folder, within = portable(file), file.parent, (*within, file)
    parts = source.get("mixture")
    if not isinstance(parts, Mapping):
        return source
    kept = {}
    for name, given in parts.items():
        entry = given if isinstance(given, Mapping) else {"weight": given}
        part = _portable(entry.get("scene", name), folder, within)
        kept[name] = {**entry, "scene": part} if isinstance(part, Mapping) else given
    return {**source, "mixture": kept}


def _human(fields: Fields) -> tuple[list[Range], Range | None]:
    """Place and heading of the human; ``None`` for where they walk to."""
    human = fields.values.get("human")
    if human is None:
        raise ValueError(
            f"{fields.where}: human is missing: every scene has one, such as human: [0, 4], or people, [] for nobody."
        )
    if is_list(human) and len(human) == 3:
        ranges = read_numbers(fields, "human", ("x", "y", "heading"), (METRES, METRES, RADIANS))
        return ranges[:2], ranges[2]
    return read_numbers(fields, "human", ("x", "y"), (METRES, METRES)), None


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
                raise ValueError(f"{self.where}: {problem.sentence_with_value(0)}.")
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
