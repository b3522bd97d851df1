"""Scenes that ship, by their names: what people meet, each in a line or two."""

from __future__ import annotations

import math

from .box_layouts import corridor, doorway, narrow_gaps, pocket, scattered, wall_across
from .layouts import Layout, mixture
from .people import (
    Draw,
    Person,
    ahead,
    any_of,
    crossing,
    nobody,
    overtaking,
    standing,
    standing_up,
    towards,
)
from .scenes import CORRIDOR, EMPTY, EXPLORING, MIXED, MOVING_HUMAN, SHOWCASE, STATIC, Scene

WALKING: Draw = (0.25, 1.2)
"""Speeds of people who walk, m/s."""

_FEW = scattered((0, 3))
_AHEAD = (-math.pi / 6, math.pi / 6)


def _scene(name: str, layout: Layout, fastest: float = 0.0) -> Scene:
    return Scene(name, layout.boxes.count, layout, fastest, len(layout.people))


def _walking(name: str, person: Person, fastest: float = WALKING[1]) -> Scene:
    return _scene(name, Layout((person,), _FEW), fastest)


_SOMEBODY = any_of(standing, towards(WALKING), crossing(WALKING))

MET: dict[str, Scene] = {
    scene.name: scene
    for scene in (
        # people
        _scene("standing", Layout((standing,), _FEW)),
        _walking("towards", towards(WALKING)),
        _walking("towards_0.5", towards((0.5, 0.5)), 0.5),
        _walking("towards_1.0", towards((1.0, 1.0)), 1.0),
        _walking("crossing", crossing(WALKING)),
        _walking("crossing_0.5", crossing((0.5, 0.5)), 0.5),
        _walking("crossing_1.0", crossing((1.0, 1.0)), 1.0),
        _walking("ahead", ahead((0.25, 0.45)), 0.45),
        _scene("overtaking", Layout((overtaking((0.6, 1.2)),), _FEW, way=(8.0, 12.0)), 1.2),
        _walking("standing_up", standing_up((0.25, 1.0)), 1.0),
        _scene("nobody", Layout((nobody,), scattered((0, 5)))),
        _scene("two_people", Layout((_SOMEBODY, _SOMEBODY), _FEW), WALKING[1]),
        # boxes
        _scene("boxes", Layout((standing,), scattered((0, 8)))),
        _scene("eight_boxes", Layout((standing,), scattered((8, 8)))),
        _scene("thin_boxes", Layout((standing,), scattered((1, 4), (0.3, 1.0), (0.02, 0.06)))),
        _scene("large_boxes", Layout((standing,), scattered((1, 3), (0.6, 1.3), (0.5, 1.0)))),
        _scene("narrow_gaps", Layout((standing,), narrow_gaps())),
        # rooms
        _scene("wall", Layout((standing,), wall_across())),
        _scene("pocket", Layout((nobody,), pocket())),
        _scene("doorway", Layout((standing,), doorway())),
        _scene("corridor_2m", Layout((standing,), corridor(2.0), heading=_AHEAD)),
        _scene("corridor_3m", Layout((_SOMEBODY,), corridor(3.0), heading=_AHEAD), WALKING[1]),
        # ways
        _scene("any_heading", Layout((standing,), scattered((3, 3)))),
        _scene("near_goal", Layout((standing,), _FEW, way=(2.0, 6.0))),
        _scene("far_goal", Layout((standing,), _FEW, way=(12.0, 15.0))),
    )
}
"""What people meet: see ``docs/how_to/scene.md``."""

# What another of them draws, too.
_ONE_OF_A_RANGE = ("towards_0.5", "towards_1.0", "crossing_0.5", "crossing_1.0", "eight_boxes")

# Who walks, and what can trap a robot, is what policies fail at: they meet it more often.
_OFTEN = {
    "crossing": 5.0,
    "towards": 3.0,
    "two_people": 4.0,
    "standing_up": 2.0,
    "overtaking": 2.0,
    "pocket": 2.0,
    "wall": 2.0,
    "doorway": 2.0,
}

EVERYDAY = mixture(
    "everyday",
    [(one, _OFTEN.get(name, 1.0)) for name, one in MET.items() if name not in _ONE_OF_A_RANGE]
    + [(EXPLORING, 4.0)],
)
"""Training for all of them: one of :data:`MET` in each episode; ``exploring``, people who cross or come
towards the robot, pockets, walls and doorways more often than the others."""

SCENES: dict[str, Scene] = {
    scene.name: scene
    for scene in (STATIC, EXPLORING, MOVING_HUMAN, MIXED, CORRIDOR, EMPTY, SHOWCASE, EVERYDAY)
} | MET
