"""Conditions of an evaluation by name: a scene, and what differs from the training."""

from __future__ import annotations

from typing import Any

from envs import Faults

SCENE_KINDS = ("static", "moving_human", "corridor")

_NOISE = {"range_noise": 0.02, "dropout": 0.02}
_SLIP = {"velocity_noise": 0.05}
_LATENCY = {"latency": 1}

CHANGES: dict[str, dict[str, Any]] = {
    "hsr": {"robot": "hsr"},
    "wheels": {"drive": "wheels"},
    "sensor": {"faults": Faults(**_NOISE)},
    "latency": {"faults": Faults(**_LATENCY)},
    "velocity": {"faults": Faults(**_SLIP)},
    "faults": {"faults": Faults(**_NOISE, **_SLIP, **_LATENCY)},
    "all": {
        "robot": "hsr",
        "drive": "wheels",
        "faults": Faults(**_NOISE, **_SLIP, **_LATENCY),
    },
}
"""Arguments of :class:`envs.NavigationEnv` by name. ``faults``: 2 cm lidar noise, 2 % lost rays, 5 %
velocity noise and a step of latency; ``all``: those, on the other robot and on wheels."""


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
            f"Unknown condition {name!r}: one of {', '.join(SCENE_KINDS)}, a change of the static "
            f"scene ({', '.join(CHANGES)}), or both, such as moving_human+faults."
        )
    defaults = {"scene": scene, "robot": "turtlebot2", "drive": "planar", "faults": None}
    return defaults | CHANGES.get(change, {})
