"""The navigation task in numbers: where everything is, when episodes end, what a step earns."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from .contacts import box_gaps, gaps, near_rows
from .fields import shown
from .geometry import cos_sin, norm
from .objectives import OBJECTIVES, RewardConstants
from .people import PERSON
from .scenes import HUMAN_RADIUS

PAPER_OBJECTIVES = ("core", "distance", "efficiency")
"""Those that the simulator computes; "demo" is a reward model's."""


class NavigationTask:
    """The episodes of ``num_envs`` robots, and the geometry behind :mod:`envs.objectives`.

    Positions are in metres, headings in radians, all arrays float64.

    Args:
        num_envs: number of episodes, ``N``.
        num_boxes: boxes in each of them, ``B``.
        num_people: people in each of them, ``P``: see :mod:`envs.people`. The human is the nearest.
        robot_radius: metres, also one an environment ``[N]``.
        goal_radius: distance at which the goal is reached, metres.
        objectives: names of the entries of the reward, in their order.
        rewards: constants of the objectives.
    """

    def __init__(
        self,
        num_envs: int,
        num_boxes: int,
        *,
        num_people: int = 1,
        robot_radius: float | np.ndarray,
        goal_radius: float,
        objectives: Sequence[str] = PAPER_OBJECTIVES,
        rewards: RewardConstants = RewardConstants(),  # noqa: B008 - it cannot change
    ) -> None:
        self.robot_radius = robot_radius
        self.goal_radius = goal_radius
        self.rewards = rewards
        self._objectives = {name: OBJECTIVES[name] for name in objectives}
        self.goal = np.zeros((num_envs, 2))
        self.people = np.zeros((num_envs, num_people, len(PERSON)))
        """``[N, P, 7]``. Call :meth:`begin` after a change."""
        self.boxes = np.zeros((num_envs, num_boxes, 5))
        """``[N, B, 5]``: x, y, heading, half length, half width. Call :meth:`begin` after a change."""
        self.way = np.zeros((2, 1 + num_people + num_boxes, num_envs))
        """From the robots to goal, people and boxes, x and y: ``[2, 1 + P + B, N]``."""
        self.distance = np.zeros((2, num_envs))
        """Of goal and human, ``[2, N]``."""
        self.radius = np.full((num_people + num_boxes, num_envs), HUMAN_RADIUS)
        """Of circles around people and boxes, ``[P + B, N]``."""
        self.flags = np.zeros((num_envs, 3), dtype=bool)
        """Why an episode ended, ``[N, 3]``: success, collision with a person, with a box."""
        self.nearest = np.zeros(num_envs, dtype=np.int64)
        """Which person is the human, ``[N]``."""
        self._touched = np.zeros((num_envs, 2), dtype=bool)
        """Whether a person or a box was touched within this step, ``[N, 2]``."""
        self._first_box = 1 + num_people
        self._hull, self._reach = np.zeros(num_envs), math.nan
        self._points = np.zeros_like(self.way)
        self._box_cos, self._box_sin = np.zeros((2, num_boxes, num_envs))

    @property
    def human_pose(self) -> np.ndarray:
        """Of the human, ``[N, 3]``; of an only one, that can be written."""
        return self._human[:, :3]

    @property
    def human_goal(self) -> np.ndarray:
        """Where the human walks to, ``[N, 2]``; of an only one, that can be written."""
        return self._human[:, 3:5]

    @property
    def _human(self) -> np.ndarray:
        if self.people.shape[1] == 1:
            return self.people[:, 0]
        return self.people[np.arange(len(self.people)), self.nearest]

    def state_dict(self) -> dict[str, np.ndarray]:
        """Where everything is, and why episodes ended."""
        return {name: value.copy() for name, value in self._arrays().items()}

    def load_state_dict(self, state: Mapping[str, np.ndarray]) -> None:
        """Take it over from episodes of the same number and kind."""
        for name, value in self._arrays().items():
            value[...] = state[name]

    def _arrays(self) -> dict[str, np.ndarray]:
        return {name: value for name, value in vars(self).items() if isinstance(value, np.ndarray)}

    def place(self, rows: np.ndarray, scene: Mapping[str, np.ndarray]) -> None:
        """Put everything of the environments ``rows`` in its place: fields of :class:`envs.Scene`.

        Where robots differ, ``robot`` [n, 8] begins with their radius.
        """
        self.goal[rows], self.boxes[rows] = scene["goal"], scene["boxes"]
        if "people" in scene:
            self.people[rows] = scene["people"]
        else:
            self.people[rows, 0, :3] = scene["human"]
            self.people[rows, 0, 3:5] = scene["human_goal"]
        if "robot" in scene:
            self.robot_radius[rows] = scene["robot"][:, 0]
            self._reach = math.nan

    def snapshot(self, rows: np.ndarray | slice, *, several: bool) -> dict[str, np.ndarray]:
        """What :meth:`place` needs to go on from here, without the human's pose if there are not several."""
        scene = {"goal": self.goal[rows].copy()}
        if several:
            scene["people"] = self.people[rows].copy()
        else:
            scene["human_goal"] = self.human_goal[rows].copy()
        return scene | {"boxes": self.boxes[rows].copy()}

    def begin(self, rows: np.ndarray, position: np.ndarray) -> None:
        """New episodes in the environments ``rows``, with all robots at ``position`` [N, 2]."""
        boxes = self.boxes[rows]
        self.flags[rows] = False
        self._points[:, 0, rows] = self.goal[rows].T
        first = self._first_box
        self._points[:, 1:first, rows] = self.people[rows, :, :2].T
        self._points[:, first:, rows] = boxes[..., :2].T
        self._box_cos[:, rows], self._box_sin[:, rows] = cos_sin(boxes[..., 2].T)
        self.radius[first - 1 :, rows] = norm(boxes[..., 3:]).T
        self.locate(position)

    def walk(
        self, seconds: float, time: np.ndarray, rows: np.ndarray | slice = slice(None)
    ) -> None:
        """People go on towards their goals.

        Args:
            seconds: for so long.
            time: from the start until then, ``[n]`` for the environments ``rows``, seconds.
            rows: where; all by default.
        """
        people = self.people[rows]
        speed, sets_out = people[..., 5], people[..., 6]
        walks = np.clip(time[:, None] + seconds - sets_out, 0.0, seconds)
        way = people[..., 3:5] - people[..., :2]
        left = norm(way)[..., None]
        step = (speed * walks)[..., None]
        people[..., :2] += way / np.maximum(left, 1e-9) * np.minimum(left, step)
        self.people[rows] = people
        self._points[:, 1 : self._first_box, rows] = people[..., :2].T

    def locate(self, position: np.ndarray) -> None:
        """See everything from the robots at ``position`` [N, 2]."""
        np.subtract(self._points, position.T[:, None], out=self.way)
        near = self.way[:, : self._first_box]
        distance = np.sqrt(np.vecdot(near, near, axis=0))
        if len(distance) > 2:
            self.nearest = distance[1:].argmin(0)
            distance = np.stack((distance[0], distance[1:].min(0)))
        self.distance = distance

    def ahead_and_left(self, cos: np.ndarray, sin: np.ndarray, rows: np.ndarray | None = None):
        """Goal, people and boxes in the frames of robots with these headings, ``[2, 1 + P + B, n]``.

        Args:
            cos: of the headings, ``[n]``.
            sin: of the headings, ``[n]``.
            rows: their environments; ``None`` for all.
        """
        x, y = self.way if rows is None else self.way[:, :, rows]
        seen = np.empty((2, *x.shape))
        np.add(cos * x, sin * y, out=seen[0])
        np.subtract(cos * y, sin * x, out=seen[1])
        return seen

    def end(self) -> np.ndarray:
        """Which episodes end, ``[N, 1]``, once the robots are located; :attr:`flags` says why."""
        goal, human = self.distance
        hit_human = human <= self.robot_radius + HUMAN_RADIUS
        hit_box = self._box_distance() <= self.robot_radius
        if self._touched.any():
            hit_human |= self._touched[:, 0]
            hit_box |= self._touched[:, 1]
            self._touched[:] = False
        hit_box &= ~hit_human
        self.flags[:, 0] = (goal <= self.goal_radius) & ~(hit_human | hit_box)
        self.flags[:, 1] = hit_human
        self.flags[:, 2] = hit_box
        return self.flags.any(1, keepdims=True)

    def may_touch(self, position: np.ndarray, reach: float) -> np.ndarray:
        """Environments of robots that have a box or a person within that reach of their hulls, ``[n]``.

        Args:
            position: of the robots, ``[N, 2]``, metres.
            reach: what robots and people can come nearer in a step, metres.
        """
        if reach != self._reach:
            self._reach = reach
            self._hull[:] = self.robot_radius + reach
        headings = self._box_cos, self._box_sin
        scene = self.boxes, self._first_box - 1, HUMAN_RADIUS
        return near_rows(self._points, position, *headings, *scene, self._hull)

    def touch(self, rows: np.ndarray, position: np.ndarray) -> None:
        """Remember what robots ``rows`` touch at ``position`` [n, 2], in the middle of a step."""
        person, box = self._gaps(position, rows)
        radius = self._radius_of(rows)
        hits_person, hits_box = person <= radius + HUMAN_RADIUS, box <= radius
        if hits_person.any() or hits_box.any():
            # Whatever came first counts.
            new = ~self._touched[rows].any(1)
            self._touched[rows, 0] |= hits_person & new
            self._touched[rows, 1] |= hits_box & ~hits_person & new

    def _gaps(self, position: np.ndarray, rows: np.ndarray) -> np.ndarray:
        boxes, people = self.boxes, self._first_box - 1
        cos, sin = self._box_cos, self._box_sin
        return gaps(self._points, position, rows, cos, sin, boxes, people)

    def _radius_of(self, rows: np.ndarray) -> np.ndarray | float:
        radius = self.robot_radius
        return radius[rows] if isinstance(radius, np.ndarray) else radius

    def _box_distance(self) -> np.ndarray:
        """From the robots' centres to the nearest box, ``[N]``, metres: zero inside, ``inf`` without boxes."""
        way = self.way[:, self._first_box :]
        return box_gaps(way, self._box_cos, self._box_sin, self.boxes)

    def clearance(self) -> np.ndarray:
        """From the robots' hulls to the nearest box, ``[N]``, metres; ``inf`` without boxes."""
        return np.maximum(self._box_distance() - self.robot_radius, 0.0)

    def reward(self, before: np.ndarray) -> np.ndarray:
        """An entry per objective ``[N, K]`` for robots that were at ``before`` [N, 2].

        Raises:
            ValueError: for an objective that gives something else than a finite number a robot.
        """
        shape = (len(before),)
        reward = np.empty((*shape, len(self._objectives)))
        for entry, (name, objective) in enumerate(self._objectives.items()):
            values = objective(self, before)
            # NumPy would take one number for all, and None for NaN.
            if not (
                isinstance(values, np.ndarray)
                and values.shape == shape
                and values.dtype.kind in "fiub"
            ):
                raise _refused(name, values, shape)
            reward[:, entry] = values
        # NaN and infinity survive a sum, which is the cheaper question.
        if not math.isfinite(np.add.reduce(reward, axis=None)) and not np.isfinite(reward).all():
            entry = int(np.argwhere(~np.isfinite(reward))[0, 1])
            raise _refused(list(self._objectives)[entry], reward[:, entry], shape)
        return reward


def _refused(name: str, values: object, shape: tuple[int, ...]) -> ValueError:
    allowed = f"an array of {shape[0]} finite numbers, one an environment"
    if not isinstance(values, np.ndarray):
        got = shown(values)
    elif values.shape != shape:
        got = f"one of shape {list(values.shape)}"
    elif values.dtype.kind not in "fiub":
        got = f"one of {values.dtype}"
    else:
        row = int(np.flatnonzero(~np.isfinite(values))[0])
        got = f"{values[row]} in environment {row}"
    return ValueError(f"objective {name!r} must return {allowed}, got {got}.")
