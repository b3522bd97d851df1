"""Scenes that are put together, mixed, and described with people."""

from __future__ import annotations

import copy
import math
import pickle

import pytest
import torch
from torchrl.envs.utils import check_env_specs

from envs import SCENES, NavigationEnv, get_scene
from envs.box_layouts import missing_boxes
from envs.catalogue import MET
from envs.layouts import Layout, mixture
from envs.people import FAR, absent
from envs.scene_checks import checked

RADIUS = 0.177


def sample(name: str, n: int = 200, radius: float = RADIUS, seed: int = 0):
    return SCENES[name].sample(n, radius, torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("name", ["boxes", "crossing", "two_people", "everyday"])
def test_a_seed_fixes_the_scenes_and_draws_from_its_generator_alone(name):
    before = torch.get_rng_state()
    first, again, other = (sample(name, 40, seed=seed) for seed in (3, 3, 4))
    assert (first == again).all() and not torch.equal(first["goal"], other["goal"])
    assert torch.equal(torch.get_rng_state(), before)


@pytest.mark.parametrize("name", ["eight_boxes", "pocket", "corridor_2m", "towards"])
@pytest.mark.parametrize("radius", [0.12, 0.35])
def test_small_and_large_robots_have_scenes(name, radius):
    scene = SCENES[name]
    checked(sample(name, 12, radius), scene, 12, radius, 0.3)


def test_boxes_are_none_to_eight():
    there = (sample("boxes")["boxes"][..., 0] < FAR / 2).sum(-1)
    assert set(there.tolist()) == set(range(9))


def test_gaps_are_narrower_than_the_robot():
    boxes = sample("narrow_gaps")["boxes"]
    for first, second in ((0, 1), (2, 3)):
        gap = boxes[:, first, 1] - boxes[:, first, 3] - boxes[:, second, 1] - boxes[:, second, 3]
        assert (gap > 0.3 * 2 * RADIUS - 1e-9).all() and (gap < 0.95 * 2 * RADIUS + 1e-9).all()


def test_corridors_are_as_wide_as_they_say():
    for name, width in (("corridor_2m", 2.0), ("corridor_3m", 3.0)):
        boxes = sample(name, 20)["boxes"]
        inner = boxes[..., 1].abs() - boxes[..., 4]
        assert (2 * inner).flatten().tolist() == pytest.approx([width] * 40)


def test_doors_are_wider_than_the_robot():
    boxes = sample("doorway")["boxes"]
    door = boxes[:, 0, 1] - boxes[:, 0, 3] - boxes[:, 1, 1] - boxes[:, 1, 3]
    assert ((door - 2 * RADIUS) >= 0.3 - 1e-9).all() and ((door - 2 * RADIUS) <= 0.6 + 1e-9).all()


def test_goals_and_headings():
    for name, low, high in (("near_goal", 2, 6), ("far_goal", 12, 15), ("any_heading", 6, 12)):
        scenes = sample(name)
        assert low <= scenes["goal"][:, 0].min() and scenes["goal"][:, 0].max() <= high
    heading = sample("any_heading")["start"][:, 2]
    assert heading.min() < -0.9 * math.pi and heading.max() > 0.9 * math.pi


def test_boxes_that_are_not_there_are_apart():
    boxes = missing_boxes(2, 3)
    assert (boxes[..., 0] >= FAR).all() and torch.unique(boxes[0, :, 1]).numel() == 3


def test_a_mixture_draws_by_weights_and_pads():
    both = mixture("both", [(SCENES["static"], 1.0), (SCENES["nobody"], 3.0)])
    assert (both.num_boxes, both.num_people) == (5, 1)
    scenes = both.sample(800, RADIUS, torch.Generator().manual_seed(0))
    share = absent(scenes["people"][:, 0]).double().mean()
    assert abs(share - 0.75) < 5 * math.sqrt(0.75 * 0.25 / 800)
    static = ~absent(scenes["people"][:, 0])
    # Static scenes have three boxes, and the last two places are empty.
    assert (scenes["boxes"][static][:, :3, 0] < FAR / 2).all()
    assert (scenes["boxes"][static][:, 3:, 0] >= FAR).all()


def test_everyday_has_everything():
    scene = SCENES["everyday"]
    assert (scene.num_boxes, scene.num_people) == (8, 2)
    checked(sample("everyday", 64), scene, 64, RADIUS, 0.3)


@pytest.mark.parametrize("name", ["everyday", "two_people", "nobody"])
def test_specs(name):
    check_env_specs(NavigationEnv(scene=name, num_envs=2, num_threads=1, seed=0, num_rays=30))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Layout(()), "people must hold at least one, such as envs.people.nobody"),
        (lambda: mixture("none", []), "mixture must name at least one scene"),
        (
            lambda: NavigationEnv(repeat_failed="x"),
            "repeat_failed must be between 0 and 1, got 'x'",
        ),
    ],
)
def test_what_is_refused_in_python(make, message):
    with pytest.raises(ValueError, match=message) as error:
        make()
    assert "\n" not in str(error.value)


def test_every_scene_can_be_copied_and_pickled():
    """So can its environment, for other processes: what comes back draws the same."""
    for name, scene in SCENES.items():
        for other in (copy.deepcopy(scene), pickle.loads(pickle.dumps(scene))):
            assert other == scene and hash(other) == hash(scene), name
    env = NavigationEnv(scene="everyday", robot="any", num_envs=2, num_threads=1, seed=3)
    other = pickle.loads(pickle.dumps(env))
    assert torch.equal(env.reset()["scan"], other.reset()["scan"])


def test_every_name_is_a_scene_that_checks_pass():
    for name, scene in MET.items():
        assert get_scene(name) is scene
        checked(scene.sample(16, RADIUS, torch.Generator().manual_seed(1)), scene, 16, RADIUS, 0.3)


WALKS = {"at": [[8, 9], 0.2], "goal": [-3, 0.2], "speed": [0.5, 1.0]}
HALL = {"name": "hall", "start": [0, 0, [-1, 1]], "goal": [8, 0]}


def test_people_from_fields():
    leaves = {"at": [4, 1.5], "goal": [4, -3], "speed": 0.6, "sets_out": [2, 5]}
    box = {"at": [4, 2.6], "size": [1, 0.3]}
    scene = get_scene({**HALL, "people": [WALKS, leaves], "boxes": [box]})
    assert (scene.num_people, scene.num_boxes, scene.human_speed) == (2, 1, 1.0)
    people = scene.sample(50, RADIUS, torch.Generator().manual_seed(0))["people"]
    assert (people[:, 0, 5] >= 0.5).all() and (people[:, 1, 5] == 0.6).all()
    assert (people[:, 1, 6] >= 2).all() and (people[:, 1, 6] <= 5).all()


def test_nobody_from_fields():
    env = NavigationEnv(scene={**HALL, "people": []}, num_envs=2, num_threads=1, seed=0)
    reset = env.reset()
    assert reset["human"][:, 0].tolist() == [4.0, 4.0]
    assert reset["human"][:, 1].tolist() == pytest.approx([math.pi] * 2)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"mixture": {}}, "mixture must be names of scenes or .yaml files with weights, got {}"),
        ({"mixture": {"static": 0}}, "mixture.static must be a weight above 0, got 0"),
        ({"mixture": {"nope": 1}}, "mixture: Unknown scene 'nope': choose one of"),
        ({"mixture": {"static": 1}, "goal": [5, 0]}, "goal and mixture exclude each other"),
        ({**HALL, "people": 3}, r"people must be a list of .*, got 3"),
        ({**HALL, "people": [3]}, r"people\[0\] must be fields .*, got 3"),
        ({**HALL, "people": [], "human": [1, 1]}, "human and people exclude each other"),
        ({**HALL, "people": [{"at": [4, 0], "goal": [1, 1]}]}, "speed must be above 0"),
        ({**HALL, "people": [{**WALKS, "speed": 9}]}, "speed must be a number of m/s from 0 to 3"),
        ({**HALL, "people": [{**WALKS, "wait": 9}]}, "unknown field 'wait'"),
        ({**HALL, "people": [{"at": [0.1, 0]}]}, "no scene found .* start must be farther from"),
        ({**HALL, "people": [{**WALKS, "speed": 2.9}]}, "no way to it that is safe from people"),
    ],
)
def test_what_is_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        NavigationEnv(scene=fields, num_envs=1, num_threads=1)
