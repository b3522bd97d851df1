"""Which scene comes next."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrl_morl.arguments import is_number

from .fields import shown
from .layouts import Layout, Mixture
from .people_files import PeopleSampler
from .robot_ranges import RobotRanges
from .scene_checks import checked
from .scene_files import SceneSampler
from .scenes import Scene

SCENE_BLOCK = 64
"""Scenes are drawn in blocks, since a block costs little more than a single scene."""

_MIXTURE_BLOCK = 256
"""And the blocks of mixtures are of several scenes each."""

# Where robots differ a block is drawn in parts, each for the largest of its robots, then mixed.
_RADII = 4

# Blocks that are kept, by the state of the generator before them.
_KNOWN_BLOCKS = 4

# The straight way to the goal takes at most so many seconds, half of an episode.
_IN_TIME = 30.0

# The latest failed scenes are kept.
_CAPACITY = 2_048


class SceneStream:
    """The scenes that a seed fixes, one after the other, between which failed ones may come again.

    A trained policy fails in one episode of hundreds: without a repetition, a batch holds hardly any
    from which it could learn more. As in prioritized level replay (Jiang et al.,
    https://arxiv.org/abs/2010.03934), with failure as the score.

    Args:
        scene: what to draw from.
        robot_radius: metres.
        num_envs: environments that play them.
        repeat_failed: share of the episodes that take place in a scene in which an episode has failed,
            once there is one.
        goal_radius: distance from the goal at which it is reached, metres.
        robots: of which every episode draws one; then scenes have ``robot`` [n, 8], too, in the order of
            ``envs.robot_ranges.DRIVEN``. They are drawn for robots up to a quarter of the range larger.

    Raises:
        ValueError: for a share that is not between 0 and 1, or a described scene that cannot be.
    """

    def __init__(
        self,
        scene: Scene,
        robot_radius: float,
        num_envs: int,
        *,
        repeat_failed: float = 0.0,
        goal_radius: float = 0.0,
        robots: RobotRanges | None = None,
    ) -> None:
        if not (is_number(repeat_failed) and 0.0 <= repeat_failed <= 1.0):
            raise ValueError(f"repeat_failed must be between 0 and 1, got {shown(repeat_failed)}.")
        self.scene = scene
        self.robot_radius = robot_radius
        self.num_envs = num_envs
        self.repeat_failed = repeat_failed
        self.goal_radius = goal_radius
        self.robots = robots
        # Before anything is trained or written. A function of the user's may keep a count.
        for described in _described(scene):
            described.check(robot_radius)
        self._known_blocks: dict[bytes, tuple[dict[str, np.ndarray], Tensor]] = {}
        self.seed(0)

    def seed(self, seed: int) -> None:
        """Start again; the new scenes follow the generator given to :meth:`deal`."""
        # Which scenes come again is drawn apart, so that the new ones stay the same.
        self._rng = np.random.default_rng(seed)
        self._known = np.zeros(self.num_envs, dtype=bool)
        self._new: dict[str, np.ndarray] | None = None
        self._failed: dict[str, np.ndarray] | None = None
        self._played: dict[str, np.ndarray] | None = None

    def state_dict(self) -> dict[str, Any]:
        """Scenes that were drawn and not dealt, those that failed and are played, and the generator."""
        return {
            "generator": self._rng.bit_generator.state,
            "known": self._known.copy(),
            **{name: getattr(self, f"_{name}") for name in ("new", "failed", "played")},
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from there."""
        self._rng.bit_generator.state = state["generator"]
        self._known = state["known"].copy()
        self._new, self._failed, self._played = (
            None if state[name] is None else {key: one.copy() for key, one in state[name].items()}
            for name in ("new", "failed", "played")
        )

    def deal(
        self, rows: np.ndarray, failed: np.ndarray, generator: torch.Generator
    ) -> dict[str, np.ndarray]:
        """Scenes for the environments ``rows``: the entries of :class:`Scene`, as arrays ``[n, ...]``.

        Args:
            rows: ``[n]``.
            failed: of the episodes that end here, ``[n]``, bool: not at the goal.
            generator: of new scenes.

        Raises:
            ValueError: for a new scene that has something wrong with it.
        """
        if not self.repeat_failed:
            return self._next(len(rows), generator)
        self._keep(rows[failed & self._known[rows]])
        again = np.zeros(len(rows), dtype=bool)
        if self._failed is not None:
            again = self._rng.random(len(rows)) < self.repeat_failed
        scenes = self._next(len(rows) - again.sum(), generator)
        if self._played is None:
            shapes = {key: values.shape[1:] for key, values in scenes.items()}
            self._played = {key: np.zeros((self.num_envs, *shapes[key])) for key in shapes}
        if again.any():
            chosen = self._rng.integers(len(self._failed["start"]), size=again.sum())
        for key, played in self._played.items():
            played[rows[~again]] = scenes[key]
            if again.any():
                played[rows[again]] = self._failed[key][chosen]
        self._known[rows] = True
        return {key: played[rows] for key, played in self._played.items()}

    def _keep(self, rows: np.ndarray) -> None:
        """What the environments ``rows`` play has been failed in."""
        if len(rows):
            scenes = {key: values[rows] for key, values in self._played.items()}
            scenes = scenes if self._failed is None else _joined(self._failed, scenes)
            self._failed = {key: values[-_CAPACITY:] for key, values in scenes.items()}

    def forget(self, rows: np.ndarray) -> None:
        """The environments ``rows`` play another scene than the one that was dealt to them."""
        self._known[rows] = False

    def _next(self, n: int, generator: torch.Generator) -> dict[str, np.ndarray]:
        while self._new is None or len(self._new["start"]) < n:
            block = self._block(generator)
            self._new = block if self._new is None else _joined(self._new, block)
        taken = {key: values[:n] for key, values in self._new.items()}
        self._new = {key: values[n:] for key, values in self._new.items()}
        return taken

    def _block(self, generator: torch.Generator) -> dict[str, np.ndarray]:
        if not isinstance(self.scene.sample, Layout | Mixture):
            return self._drawn(generator)
        # An evaluation begins with the same seed for every preference, and these scenes take long to find.
        before = generator.get_state().numpy().tobytes()
        if before in self._known_blocks:
            block, after = self._known_blocks[before]
            generator.set_state(after)
            return block
        block = self._drawn(generator)
        self._known_blocks[before] = block, generator.get_state()
        if len(self._known_blocks) > _KNOWN_BLOCKS:
            del self._known_blocks[next(iter(self._known_blocks))]
        return block

    def _drawn(self, generator: torch.Generator) -> dict[str, np.ndarray]:
        size = _MIXTURE_BLOCK if isinstance(self.scene.sample, Mixture) else SCENE_BLOCK
        if self.robots is None:
            block = self._sample(size, self.robot_radius, generator)
            return {key: values.numpy() for key, values in block.items()}
        low, high = self.robots.radius
        ends = torch.linspace(low, high, _RADII + 1, dtype=torch.float64).tolist()
        parts = [
            self._with_robots(size // 2, ends[part : part + 2], generator)
            for part in range(_RADII if high > low else 1)
        ]
        order = torch.randperm(sum(len(part["start"]) for part in parts), generator=generator)
        return {key: torch.cat([part[key] for part in parts])[order].numpy() for key in parts[0]}

    def _sample(self, size: int, radius: float, generator: torch.Generator) -> dict[str, Tensor]:
        block = self.scene.sample(size, radius, generator)
        return dict(checked(block, self.scene, size, radius, self.goal_radius))

    def _with_robots(
        self, size: int, radii: Sequence[float], generator: torch.Generator
    ) -> dict[str, Tensor]:
        """Scenes for the larger of two radii, with robots between them."""
        block = self._sample(size, radii[1], generator)
        way = (block["goal"] - block["start"][:, :2]).norm(dim=-1)
        among = dataclasses.replace(self.robots, radius=tuple(radii))
        return block | {"robot": among.draw(size, generator, slowest=way / _IN_TIME)}


def _described(scene: Scene) -> Iterator[SceneSampler | PeopleSampler]:
    """What files and mappings say, also within mixtures."""
    if isinstance(scene.sample, Mixture):
        for part in scene.sample.scenes:
            yield from _described(part)
    elif isinstance(scene.sample, SceneSampler | PeopleSampler):
        yield scene.sample


def _joined(first: dict[str, np.ndarray], second: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {key: np.concatenate((first[key], second[key])) for key in first}
