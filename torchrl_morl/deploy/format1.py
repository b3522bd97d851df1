"""Folders of format 1: what their cards say about sensing, in their words."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from .entries import Entries
from .sensing import Limits, Sensing

_NEW_NAMES = {
    "perturbation": "faults",
    "law": "distribution",
    "relabel_law": "relabel_distribution",
}
_LIDAR_AHEAD = {"turtlebot2": 0.0, "hsr": 0.15}
_WALKING = ("mixed", "moving_human")
PERIOD = 0.2


def renamed(card: Mapping[str, Any]) -> dict[str, Any]:
    """A card with the names of today in its configurations, those of earlier stages included."""
    card = dict(card)
    if isinstance(card.get("config"), dict):
        card["config"] = _renamed(card["config"])
    if isinstance(card.get("start"), dict):
        card["start"] = renamed(card["start"])
    return card


def _renamed(value: Any) -> Any:
    if not isinstance(value, dict):
        return value
    return {_NEW_NAMES.get(name, name): _renamed(entry) for name, entry in value.items()}


def sensing_of(card: Mapping[str, Any], where: str) -> tuple[Sensing, Limits, str] | None:
    """Sensing, limits and robot of a policy of format 1; ``None`` if its card does not tell.

    Raises:
        ValueError: for an entry of another type.
    """
    entries = Entries(card, f"{where}: card")
    if "config" not in entries or "env" not in entries.object("config"):
        return None
    env = entries.object("config").object("env")
    robot = env.choice("robot", tuple(_LIDAR_AHEAD)) if "robot" in env else "turtlebot2"
    scale = {"max_range": env.number("max_range")} if "max_range" in env else {}
    walking = env.get("scene") in _WALKING
    flags = {
        name: env.flag(name) for name in ("observe_human", "observe_human_velocity") if name in env
    }
    sensing = Sensing(
        lidar_origin=(_LIDAR_AHEAD[robot], 0.0),
        unknown_range=scale.get("max_range", 4.0),
        human_range=(0.4, 12.0 if walking else 8.0),
        **scale,
        **flags,
    )
    return sensing, Limits(), robot
