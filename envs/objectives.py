"""What a step of the navigation task earns: one function per objective, and the constants they share.

Another objective is another function here and its entry in :data:`OBJECTIVES`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from torchrl_morl.arguments import is_number

from .fields import shown
from .geometry import norm
from .scenes import HUMAN_RADIUS

# Beyond it rewards would be infinite.
_LARGEST = 3.4e38


@dataclasses.dataclass(frozen=True)
class RewardConstants:
    """Constants of the objectives; the defaults are those of the paper, which knows no clearance.

    Args:
        goal_reward: for each metre by which the goal comes nearer, above 0.
        collision_reward: for a collision, at most 0.
        discomfort_reward: for each step in which the robot all but touches a person, at most 0; nothing from
            ``discomfort_distance`` on, and linearly between.
        discomfort_distance: between the hulls of robot and person, metres.
        style_penalty: for each step without hurry, and at most for one of another style, below 0.
        distance_threshold: distance to the human's centre, metres, from which closeness costs.
        distance_minimum: where it costs ``style_penalty``, metres, below the threshold.
        clearance_threshold: distance from the robot's hull to a box, metres, from which closeness
            costs; contact costs ``style_penalty``.

    Raises:
        ValueError: for a value of another type or outside these limits.

    Examples:
        >>> RewardConstants(collision_reward=-500.0).goal_reward
        125.0
    """

    goal_reward: float = 125.0
    collision_reward: float = -1000.0
    discomfort_reward: float = 0.0
    discomfort_distance: float = 0.3
    style_penalty: float = -10.0
    distance_threshold: float = 2.0
    distance_minimum: float = 0.3
    clearance_threshold: float = 1.0

    def __post_init__(self) -> None:
        for name, allowed, fits in (
            ("goal_reward", "a number above 0", lambda value: value > 0),
            ("collision_reward", "a number, at most 0", lambda value: value <= 0),
            ("discomfort_reward", "a number, at most 0", lambda value: value <= 0),
            ("discomfort_distance", "a number of metres above 0", lambda value: value > 0),
            ("style_penalty", "a number below 0", lambda value: value < 0),
            ("distance_threshold", "a number of metres above 0", lambda value: value > 0),
            (
                "distance_minimum",
                "a number of metres, from 0 to below distance_threshold "
                f"({shown(self.distance_threshold)})",
                lambda value: 0 <= value < self.distance_threshold,
            ),
            ("clearance_threshold", "a number of metres above 0", lambda value: value > 0),
        ):
            value = getattr(self, name)
            if is_number(value) and abs(value) > _LARGEST:
                raise ValueError(
                    f"rewards: {name} must be a number that float32 holds, up to {_LARGEST:g}, got "
                    f"{shown(value)}."
                )
            if not (is_number(value) and fits(value)):
                raise ValueError(f"rewards: {name} must be {allowed}, got {shown(value)}.")


class Task(Protocol):
    """What an objective may look at, of :class:`envs.navigation_task.NavigationTask`."""

    goal: np.ndarray
    """``[N, 2]``, metres."""
    distance: np.ndarray
    """Of goal and human from the robots, ``[2, N]``, metres."""
    flags: np.ndarray
    """Success, collision with the human, with a box: bool ``[N, 3]``."""
    rewards: RewardConstants
    robot_radius: float | np.ndarray
    """Metres; ``[N]`` where robots differ."""

    def clearance(self) -> np.ndarray:
        """From the robots' hulls to the nearest box, ``[N]``, metres."""


def core(task: Task, before: np.ndarray) -> np.ndarray:
    """Approach of the goal, and collisions (equation 2 of the paper, its sign corrected).

    With a ``discomfort_reward`` also all but touching people, as Chen et al. charge for it
    (https://arxiv.org/abs/1809.08835): a collision alone says nothing before it happens.
    """
    distance_before, (distance, human) = norm(task.goal - before), task.distance
    collided = task.flags[:, 1] | task.flags[:, 2]
    rewards = task.rewards
    earned = (
        rewards.goal_reward * (distance_before - distance) + rewards.collision_reward * collided
    )
    if rewards.discomfort_reward:
        gap = human - task.robot_radius - HUMAN_RADIUS
        share = 1.0 - gap.clip(0.0, rewards.discomfort_distance) / rewards.discomfort_distance
        earned += rewards.discomfort_reward * share
    return earned


def distance(task: Task, before: np.ndarray) -> np.ndarray:
    """Closeness to the human's centre, squared (equation 3)."""
    rewards, human = task.rewards, task.distance[1]
    closeness = np.maximum(rewards.distance_threshold - human, 0.0)
    share = closeness / (rewards.distance_threshold - rewards.distance_minimum)
    return rewards.style_penalty * share**2


def efficiency(task: Task, before: np.ndarray) -> np.ndarray:
    """Every step costs the same (equation 4)."""
    return np.full(len(before), task.rewards.style_penalty)


def clearance(task: Task, before: np.ndarray) -> np.ndarray:
    """Closeness of the robot's hull to the nearest box, squared."""
    threshold = task.rewards.clearance_threshold
    closeness = np.maximum(threshold - task.clearance(), 0.0)
    return task.rewards.style_penalty * (closeness / threshold) ** 2


Objective = Callable[[Task, np.ndarray], np.ndarray]

OBJECTIVES: dict[str, Objective] = {
    "core": core,
    "distance": distance,
    "efficiency": efficiency,
    "clearance": clearance,
}
"""``objective(task, before)`` is what the step earned that led robots from ``before`` [N, 2] to where
they are, ``[N]`` and finite."""


def get_rewards(rewards: RewardConstants | Mapping[str, Any] | None) -> RewardConstants:
    """Return the constants, made from their mapping (a configuration) if need be.

    Raises:
        ValueError: for a constant that does not exist, or one that is refused.
    """
    if isinstance(rewards, RewardConstants):
        return rewards
    if not isinstance(rewards, (Mapping, type(None))):
        raise ValueError(
            f"rewards must be an envs.RewardConstants or a mapping, got {shown(rewards)}."
        )
    known = [field.name for field in dataclasses.fields(RewardConstants)]
    for name in rewards or {}:
        if name not in known:
            raise ValueError(f"rewards: unknown constant {shown(name)}: choose among {known}.")
    return RewardConstants(**(rewards or {}))


def check_objectives(objectives: Sequence[str]) -> tuple[str, ...]:
    """The names, in their order.

    Raises:
        ValueError: for names that are none, unknown or there twice.
    """
    if isinstance(objectives, str) or not isinstance(objectives, Sequence) or not objectives:
        raise ValueError(f"objectives must be a list of names, got {shown(objectives)}.")
    for name in objectives:
        if not isinstance(name, str) or name not in OBJECTIVES:
            raise ValueError(f"Unknown objective {shown(name)}: choose among {list(OBJECTIVES)}.")
        if not callable(OBJECTIVES[name]):
            raise ValueError(
                f"OBJECTIVES[{name!r}] must be a function of (task, before), got "
                f"{shown(OBJECTIVES[name])}."
            )
    if len(set(objectives)) < len(objectives):
        raise ValueError(f"objectives must differ, got {shown(list(objectives))}.")
    return tuple(objectives)
