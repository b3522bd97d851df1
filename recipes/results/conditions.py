"""Conditions of an evaluation by name: a scene, and what differs from the training."""

from __future__ import annotations

import dataclasses
from typing import Any

import torch

from envs import Faults, Robot
from envs.catalogue import MET
from envs.robot_ranges import ANY_ROBOT

SCENE_KINDS = ("static", "moving_human", "corridor", *MET)

_NOISE = {"range_noise": 0.02, "dropout": 0.02}
_SLIP = {"velocity_noise": 0.05}
_LATENCY = {"latency": 1}

_DRAWN_BY = 29
"""Seed of the robots below: another generator than that of any training."""


def _robots(count: int) -> list[Robot]:
    """Robots drawn once and for all from the ranges of ``any``."""
    numbers = ANY_ROBOT.draw(count, torch.Generator().manual_seed(_DRAWN_BY))
    return [
        dataclasses.replace(ANY_ROBOT.robot(one), name=f"robot_{place}")
        for place, one in enumerate(numbers, start=1)
    ]


CHANGES: dict[str, dict[str, Any]] = {
    "hsr": {"robot": "hsr"},
    "wheels": {"drive": "wheels"},
    "sensor": {"faults": Faults(**_NOISE)},
    "latency": {"faults": Faults(**_LATENCY)},
    "latency_2": {"faults": Faults(latency=2)},
    "latency_3": {"faults": Faults(latency=3)},
    "velocity": {"faults": Faults(**_SLIP)},
    "faults": {"faults": Faults(**_NOISE, **_SLIP, **_LATENCY)},
    "hsr_wheels_faults": {
        "robot": "hsr",
        "drive": "wheels",
        "faults": Faults(**_NOISE, **_SLIP, **_LATENCY),
    },
    "invalid_beams": {"faults": Faults(invalid_beams=0.1)},
    "unknown_sectors": {"faults": Faults(unknown_angle=0.6)},
    "lag": {"faults": Faults(lag=0.4)},
    "slow_base": {"faults": Faults(speed_scale=0.8, turn_scale=0.8)},
    "fast_base": {"faults": Faults(speed_scale=1.15, turn_scale=1.2)},
    "goal_drift": {"faults": Faults(goal_drift=0.15)},
    "human_noise": {"faults": Faults(human_noise=0.2)},
    "human_bias": {"faults": Faults(human_bias=0.3)},
    "human_lost": {"faults": Faults(human_lost=0.2)},
    **{robot.name: {"robot": robot} for robot in _robots(10)},
}
"""Arguments of :class:`envs.NavigationEnv` by name. ``faults``: 2 cm lidar noise, 2 % lost rays, 5 %
velocity noise and a step of latency; ``hsr_wheels_faults``: those, on the other robot and on wheels;
``robot_1`` to ``robot_10``: drawn once from the ranges of the robot ``any``."""

ALL = "all"
"""Stands for every scene, and every change of the static one."""


def condition(name: str) -> dict[str, Any]:
    """Arguments of :class:`envs.NavigationEnv` for ``SCENE``, ``CHANGE`` or ``SCENE+CHANGE``.

    A change alone is one of the static scene.

    Raises:
        ValueError: for an unknown name.

    Examples:
        >>> condition("corridor+wheels")
        {'scene': 'corridor', 'robot': 'turtlebot2', 'drive': 'wheels', 'faults': None}
    """
    scene, _, change = name.partition("+")
    if not change and scene in CHANGES:
        scene, change = "static", scene
    if scene not in SCENE_KINDS or (change and change not in CHANGES) or name.endswith("+"):
        raise ValueError(
            f"Unknown condition {name!r}: {ALL}, one of {', '.join(SCENE_KINDS)}, a change of the "
            f"static scene ({', '.join(CHANGES)}), or both, such as moving_human+faults."
        )
    defaults = {"scene": scene, "robot": "turtlebot2", "drive": "planar", "faults": None}
    return defaults | CHANGES.get(change, {})


def conditions(names: list[str]) -> list[str]:
    """The names, with every condition in place of ``all``, each once.

    Raises:
        ValueError: for an unknown name.

    Examples:
        >>> conditions(["hsr", "all"])[:3]
        ['hsr', 'static', 'moving_human']
    """
    every = [one for name in names for one in ([*SCENE_KINDS, *CHANGES] if name == ALL else [name])]
    for name in every:
        condition(name)
    return list(dict.fromkeys(every))
