"""Scene files with people: what is wrong with one of them is said in one line, with field and value."""

from __future__ import annotations

import math

import pytest
import torch

from envs import HUMAN_RADIUS, NavigationEnv, Scene, get_scene

HALL = {"start": [0, 0, 0], "goal": [8, 0]}
STANDS = {"at": [4, 2]}
WALKS = {"at": [4, 2], "goal": [4, -2], "speed": 0.5}
BOX = {"at": [4, 2], "size": [1, 1]}
WALL = {"at": [4, 5], "size": [12, 0.2]}


def refused(message: str, **fields) -> str:
    given = {name: value for name, value in {**HALL, **fields}.items() if value is not ...}
    with pytest.raises(ValueError, match=message) as error:
        NavigationEnv(scene=given, num_threads=1, seed=0)
    line = str(error.value)
    assert line.startswith("the mapping of the scene: ") and "\n" not in line and len(line) < 250
    return line


@pytest.mark.parametrize(
    ("person", "message"),
    [
        ({**WALKS, "speed": 0}, r"people\[0\]\.speed must be above 0 for who has a goal, got 0\."),
        ({"at": [4, 2], "goal": [4, -2]}, r"people\[0\]\.speed must be above 0 .*, got 0\.0\."),
        ({**WALKS, "speed": [0, 0]}, r"people\[0\]\.speed must be above 0 .*, got \[0, 0\]\."),
        (
            {"at": [4, 2], "speed": 0.5},
            r"people\[0\]\.goal is missing, where who has a speed of 0\.5 m/s walks to: \[x, y\]",
        ),
        ({**STANDS, "sets_out": 5}, r"people\[0\]\.sets_out needs a goal to walk to, got 5\."),
        ({**WALKS, "speed": -1}, r"people\[0\]\.speed must be a number of m/s .*, got -1\."),
        ({**WALKS, "speed": [1, 0.5]}, r"people\[0\]\.speed must be .*, got \[1, 0\.5\]\."),
        ({**WALKS, "sets_out": 61}, r"people\[0\]\.sets_out must be a number of seconds .* 61\."),
        (
            {**WALKS, "velocity": 1},
            r"unknown field 'velocity' of people\[0\]\. Fields are at, goal",
        ),
        ({"goal": [4, 2], "speed": 1}, r"people\[0\]\.at is missing: \[x, y\], each a number"),
        ({"at": [4, 2, 1]}, r"people\[0\]\.at must be \[x, y\], .*, got \[4, 2, 1\]\."),
        ({"at": [4, math.nan]}, r"y of people\[0\]\.at must be a number of metres .*, got nan\."),
        (None, r"people\[0\] must be fields {at, goal, speed, sets_out}, got None\."),
    ],
)
def test_a_person_that_is_refused_when_read(person, message):
    refused(message, people=[person])


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (
            {"people": [WALKS | {"at": [2, 2], "goal": [2, -2]}, STANDS], "boxes": [BOX]},
            r"people\[1\] must be farther from boxes\[0\] than .* 0\.25 m, got \[4\.0, 2\.0\]\.",
        ),
        (
            {"people": [{**WALKS, "goal": [4, 9]}], "boxes": [WALL]},
            r"people\[0\]\.goal must be reached on a line .* boxes\[0\], got \[4\.0, 9\.0\]\.",
        ),
        (
            {"people": [STANDS, {"at": [0.2, 0]}]},
            r"start must be farther from people\[1\] than both radii, 0\.427 m, got \[0\.0, ",
        ),
        (
            {"people": [{"at": [8, 0.1]}]},
            r"goal must be farther from people\[0\] than both radii, 0\.427 m, got \[8\.0, 0\.0\]",
        ),
        (
            {"people": [STANDS, WALKS]},
            r"people\[1\] must be farther from people\[0\] than both radii, 0\.5 m, got \[4\.0, 2",
        ),
        (
            {"people": [{"at": [4, -2]}, STANDS, {"at": [4, 2.4]}]},
            r"people\[2\] must be farther from people\[1\] than both radii, 0\.5 m, got \[4\.0, 2\.4",
        ),
        (
            {"people": [{"at": [9, 0], "goal": [-3, 0], "speed": 3}]},
            r"goal must have a way to it for a robot of radius 0\.177 m that is safe from people",
        ),
    ],
)
def test_a_fixed_scene_is_refused_for_what_is_wrong_with_it(fields, message):
    assert "Widen" not in refused(message, **fields)


def test_ranges_that_hold_no_scene_are_given_up():
    inside = {"at": [[3.8, 4.2], [1.9, 2.1]]}
    line = refused(
        r"no scene found .* people\[0\] must be farther from boxes\[0\]",
        people=[inside],
        boxes=[BOX],
    )
    assert line.endswith("Widen the ranges.")
    refused("no scene found .* people.1. must be farther from people.0.", people=[inside, inside])


def test_people_are_drawn_apart():
    near = {"at": [[3.5, 4.5], 2]}
    scene = get_scene({**HALL, "people": [near, near, {"at": [4, 4]}]})
    places = scene.sample(64, 0.177, torch.Generator().manual_seed(0))["people"][..., :2]
    assert (places[:, 0] - places[:, 1]).norm(dim=-1).min() > 2 * HUMAN_RADIUS


def test_a_fixed_scene_is_the_same_for_every_seed():
    env = NavigationEnv(scene={**HALL, "people": [WALKS]}, num_envs=3, num_threads=1, seed=0)
    rows = env.reset()["scene", "people"][:, 0]
    expected = [4.0, 2.0, -math.pi / 2, 4.0, -2.0, 0.5, 0.0]
    assert rows.tolist() == [pytest.approx(expected)] * 3


def test_what_a_function_says_of_people_is_refused_by_the_person():
    scene = get_scene(
        {**HALL, "people": [STANDS, {"at": [2, 2]}], "boxes": [BOX | {"at": [4, -2]}]}
    )

    def sample(n, robot_radius, generator):
        fields = scene.sample(n, robot_radius, generator)
        fields["people"][3, 1, :2] = torch.tensor([4.0, -2.0], dtype=torch.float64)
        return fields

    env = NavigationEnv(scene=Scene("mine", 1, sample, 0.0, 2), num_threads=1, seed=0)
    message = r"'mine', scene 3 of 64: people\[1\] must be .* boxes\[0\] .*, got \[4\.0, -2\.0\]\.$"
    with pytest.raises(ValueError, match=message):
        env.reset()


def test_a_scene_of_a_mixture_is_refused_before_it_is_drawn():
    """It may be drawn for the first time after hours."""
    bad = {**HALL, "people": [{"at": [8, 0]}]}
    inner = {"mixture": {"bad": {"weight": 1, "scene": bad}, "empty": 1}}
    refused(
        r"goal must be farther from people\[0\]",
        start=...,
        goal=...,
        mixture={"static": 1000, "inner": {"weight": 1, "scene": inner}},
    )
