"""Where a policy was trained to drive, from its card: evaluations, films and demos take place there."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args

from envs import TURTLEBOT2, Robot, RobotRanges, Scene, get_robots, get_scene
from envs.demonstrations import CircleDemonstrator
from envs.fields import shown
from envs.mjcf import Drive
from envs.policy_env import observed
from envs.robot_ranges import largest
from envs.splits import TEST_SEEDS, check_test_seed
from torchrl_morl.arguments import is_number
from torchrl_morl.deploy import training_config
from torchrl_morl.deploy.features import observation_parts

GOAL_RADIUS = 0.3
"""Where a card does not say otherwise, metres."""

DEMONSTRATED = 0.5
"""The same, m/s."""


@dataclasses.dataclass(frozen=True)
class Setting:
    """A scene, a robot and how it drives.

    Args:
        scene: of the evaluations of the training.
        robot: that was trained, or the ranges of which every episode draws one.
        drive: of it.
        goal_radius: distance at which the goal is reached, metres.
        observed: what the policy observes, arguments of :func:`envs.policy_env.make_policy_env`.
    """

    scene: Scene
    robot: Robot | RobotRanges
    drive: Drive = "planar"
    goal_radius: float = GOAL_RADIUS
    observed: dict[str, bool] = dataclasses.field(default_factory=dict)

    @property
    def arguments(self) -> dict[str, Any]:
        """Of :func:`envs.policy_env.make_policy_env`."""
        names = ("scene", "robot", "drive", "goal_radius")
        return {name: getattr(self, name) for name in names} | self.observed

    @property
    def with_one_robot(self) -> Setting:
        """The same for what shows one robot: a TurtleBot 2 where every episode draws its own."""
        if isinstance(self.robot, Robot):
            return self
        return dataclasses.replace(self, robot=TURTLEBOT2)

    @property
    def with_one_human(self) -> Setting:
        """The same for what shows one human: ``static`` where people have ways of their own."""
        if self.scene.num_people is None:
            return self
        return dataclasses.replace(self, scene=get_scene("static"))

    def __str__(self) -> str:
        several = isinstance(self.robot, RobotRanges)
        robot = f"{self.robot.name} (another in every episode)" if several else self.robot.name
        return (
            f"scene {self.scene.name}, robot {robot}, drive {self.drive}, "
            f"goal radius {self.goal_radius:g} m"
        )


def trained_in(card: Mapping[str, Any]) -> Setting:
    """What the card says; static scenes and a TurtleBot 2 where it does not.

    Raises:
        ValueError: for what the card must not say, in one line.

    Examples:
        >>> str(trained_in({"config": {"env": {"robot": "hsr", "drive": "wheels"}}}))
        'scene static, robot hsr, drive wheels, goal radius 0.3 m'
    """
    env, evaluation = (training_config(card, section) for section in ("env", "evaluation"))
    drive, goal_radius = env.get("drive") or "planar", env.get("goal_radius") or GOAL_RADIUS
    if drive not in get_args(Drive):
        raise ValueError(
            f"card: config.env.drive must be one of {', '.join(get_args(Drive))}, got {shown(drive)}."
        )
    if not is_number(goal_radius) or goal_radius <= 0:
        raise ValueError(
            f"card: config.env.goal_radius must be a number of metres above 0, got {shown(goal_radius)}."
        )
    seen = observed({name: value for name, value in env.items() if value is not None})
    try:
        observation_parts(**seen)
    except ValueError as error:
        raise ValueError(f"card: config.env: {error}") from error
    return Setting(
        scene=get_scene(evaluation.get("scene") or "static"),
        robot=get_robots(env.get("robot") or "turtlebot2"),
        drive=drive,
        goal_radius=goal_radius,
        observed=seen,
    )


def choose(
    card: Mapping[str, Any],
    *,
    scene: str | None = None,
    robot: str | None = None,
    drive: str | None = None,
    one_robot: bool = False,
) -> Setting:
    """The setting of the card, but for what is given; says which, and what that means.

    Keyword Args:
        one_robot: for what shows one: :attr:`Setting.with_one_robot`.

    Raises:
        ValueError: for a scene or robot that does not exist, or a card that :func:`trained_in` or
            :func:`demonstrator` refuses.
    """
    trained = trained_in(card)
    given = {"scene": scene, "robot": robot, "drive": drive}
    parse = {"scene": get_scene, "robot": get_robots, "drive": str}
    changes = {name: parse[name](value) for name, value in given.items() if value is not None}
    setting = dataclasses.replace(trained, **changes)
    if one_robot:
        setting = setting.with_one_robot
    demonstrator(card, setting.robot)  # what it refuses is refused before anything is said
    print(f"{setting}")
    if "robot" in changes:
        changes["robot"] = setting.robot  # of ranges, the one that drives
    for name, value in changes.items():
        if name != "scene" and (unlike := _unlike(value, getattr(trained, name))):
            print(f"note: --{name} {_named(value)} {unlike}: this measures how well it transfers.")
    return setting


def _unlike(value: Robot | RobotRanges | str, trained: Robot | RobotRanges | str) -> str | None:
    """How it is not what a policy was trained with; ``None`` if it is, or lies within its ranges."""
    if value == trained:
        return None
    if not isinstance(trained, RobotRanges) or isinstance(value, str):
        return f"is not what the policy was trained with, {_named(trained)}"
    outside = trained.outside(value)
    if not outside:
        return None
    return f"is outside of what the policy was trained with: {', '.join(outside)}"


def reads_preference(card: Mapping[str, Any]) -> bool:
    """Whether a policy drives otherwise under another preference; not if its training ignored it.

    Examples:
        >>> reads_preference({}), reads_preference({"preference": "ignored"})
        (True, False)
    """
    return card.get("preference") != "ignored"


def scene_seed(text: str) -> int:
    """A type for :mod:`argparse`: scenes that no training and no choice of a checkpoint has seen."""
    try:
        return check_test_seed(int(text))
    except ValueError as error:
        allowed = f"must be a whole number from {TEST_SEEDS.start} to {TEST_SEEDS[-1]}"
        reason = str(error) if text.isdecimal() else f"{allowed}, got {text!r}"
        raise argparse.ArgumentTypeError(reason) from error


def demonstration(card: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments of the demonstrator that a card names, but for its robot; empty if it names none.

    Raises:
        ValueError: for others than a circle has, or of another type.
    """
    given = card.get("demonstrator", {})
    if not isinstance(given, Mapping):
        raise ValueError(f"card: demonstrator must be an object, got {shown(given)}.")
    for name, value in given.items():
        if name not in ("radius", "side", "speed", "robot"):
            raise ValueError(f"card: demonstrator has radius, side and speed, not {shown(name)}.")
        if name in ("radius", "speed") and not is_number(value):
            raise ValueError(f"card: demonstrator.{name} must be a number, got {shown(value)}.")
    return {name: value for name, value in given.items() if name != "robot"}


def demonstration_on(
    given: Mapping[str, Any], robot: str | Path | Mapping[str, Any] | Robot | RobotRanges
) -> dict[str, Any]:
    """Arguments of the demonstrator on a robot: a slower one shows the same at its own speed, in m/s.

    Args:
        given: of :class:`envs.demonstrations.CircleDemonstrator`; its robot is replaced.
        robot: who shows it; of ranges the fastest counts.

    Examples:
        >>> slow = {"radius": 0.2, "max_speed": 0.3}
        >>> demonstration_on({"radius": 1.0, "speed": 0.4}, slow)["speed"]
        0.3
    """
    fastest = largest(get_robots(robot)).max_speed
    speed = min(given.get("speed", DEMONSTRATED), fastest)
    return {**given, "speed": speed, "robot": robot}


def demonstrator(card: Mapping[str, Any], robot: Robot | RobotRanges) -> CircleDemonstrator | None:
    """Drives what the policy was shown, on a robot; ``None`` for recorded demonstrations, or none.

    A policy of many robots was shown it by slower ones at their own speed.

    Raises:
        ValueError: for what no demonstrator is, or what this robot cannot drive.
    """
    if "demonstrator" not in card:
        return None
    arguments = {**demonstration(card), "robot": robot}
    trained = training_config(card, "env").get("robot") or "turtlebot2"
    if isinstance(get_robots(trained), RobotRanges):
        arguments = demonstration_on(arguments, robot)
    try:
        return CircleDemonstrator(**arguments)
    except ValueError as error:
        raise ValueError(f"card: demonstrator: {error}") from error


def _named(value: Scene | Robot | RobotRanges | str) -> str:
    return value if isinstance(value, str) else value.name
