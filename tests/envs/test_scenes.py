"""Sampled scenes are free of overlaps and solvable, checked without the library's own geometry."""

from __future__ import annotations

import functools
import math

import numpy as np
import pytest
import torch
from scipy import ndimage

from envs import (
    CORRIDOR,
    EMPTY,
    EXPLORING,
    HSR,
    HUMAN_RADIUS,
    MOVING_HUMAN,
    SCENES,
    SHOWCASE,
    STATIC,
    TURTLEBOT2,
    NavigationEnv,
    Robot,
    get_robot,
    get_scene,
)

COUNT = 10_000
SAMPLED = [STATIC, EXPLORING, MOVING_HUMAN, CORRIDOR, EMPTY]


@functools.cache
def _sample(scene, robot=TURTLEBOT2, n=COUNT, seed=0):
    return scene.sample(n, robot.radius, torch.Generator().manual_seed(seed))


def _arrays(scene, **kwargs):
    return {key: value.numpy() for key, value in _sample(scene, **kwargs).items()}


def _box_distance(x, y, box):
    """Distance of points to a filled box, zero inside; all arguments broadcast."""
    cos, sin = np.cos(box[..., 2]), np.sin(box[..., 2])
    dx, dy = x - box[..., 0], y - box[..., 1]
    along = np.maximum(np.abs(cos * dx + sin * dy) - box[..., 3], 0)
    across = np.maximum(np.abs(cos * dy - sin * dx) - box[..., 4], 0)
    return np.hypot(along, across)


def _outline(boxes, per_side=15):
    """Points on the outlines of boxes ``[..., 5]``: ``[..., 4 * per_side, 2]``."""
    t = np.linspace(-1, 1, per_side)
    one = np.ones_like(t)
    u = np.concatenate((t, one, -t, -one)) * boxes[..., 3:4]
    v = np.concatenate((-one, t, one, -t)) * boxes[..., 4:5]
    cos, sin = np.cos(boxes[..., 2:3]), np.sin(boxes[..., 2:3])
    return np.stack(
        (boxes[..., 0:1] + cos * u - sin * v, boxes[..., 1:2] + sin * u + cos * v), axis=-1
    )


def _path_exists(scene, row, *, radius, cell, human=True) -> bool:
    """Whether a flood fill finds a path of the robot from start to goal.

    The answer "yes" is proof. A cell counts as free where its centre keeps the robot's radius
    plus half a cell from everything: straight moves between the centres of free neighbours, each
    point of which is within half a cell of one of them, are then free. So are the moves from start
    and goal to the nearest centres, 0.71 cells at most, since both keep 0.1 m beyond the radius.
    """
    assert cell <= 0.1
    margin = radius + cell / 2
    ends = np.stack((scene["start"][row, :2], scene["goal"][row]))
    low = ends.min(0) - 3.0
    shape = np.ceil((ends.max(0) + 3.0 - low) / cell).astype(int) + 1
    free = np.ones(shape, dtype=bool)
    obstacles = [(box, np.hypot(*box[3:])) for box in scene["boxes"][row]]
    if human:
        obstacles.append((np.array([*scene["human"][row, :2], 0, 0, 0]), HUMAN_RADIUS))
    for index, (box, reach) in enumerate(obstacles):
        # Only cells this near can be affected.
        first = np.floor((box[:2] - low - reach - margin) / cell).astype(int).clip(0)
        last = np.ceil((box[:2] - low + reach + margin) / cell).astype(int).clip(0) + 1
        window = (slice(first[0], last[0]), slice(first[1], last[1]))
        x, y = (low[i] + cell * np.arange(shape[i])[window[i]] for i in range(2))
        grown = margin + HUMAN_RADIUS * (index == len(scene["boxes"][row]))
        free[window] &= _box_distance(x[:, None], y, box) > grown
    regions = ndimage.label(free)[0]
    cells = np.rint((ends - low) / cell).astype(int)
    labels = regions[cells[:, 0], cells[:, 1]]
    return bool(labels[0] > 0 and labels[0] == labels[1])


def _unsolved(scene, rows, **kwargs):
    return [row for row in rows if not _path_exists(scene, row, **kwargs)]


def test_the_oracle_itself_tells_open_from_closed():
    # A wall with a doorway: the 0.4 m robot passes 0.65 m, but not 0.35 m.
    for gap, passes in ((0.65, True), (0.35, False)):
        half = (20.0 - gap) / 4
        scene = {
            "start": np.zeros((1, 3)),
            "goal": np.array([[6.0, 0.0]]),
            "human": np.array([[3.0, 9.0, 0.0]]),
            "boxes": np.array([[[3.0, s * (gap / 2 + half), 0.0, 0.2, half] for s in (1, -1)]]),
        }
        for cell in (0.1, 0.05):
            assert _path_exists(scene, 0, radius=0.2, cell=cell) is passes


@pytest.mark.parametrize("robot", [TURTLEBOT2, HSR], ids=lambda robot: robot.name)
@pytest.mark.parametrize("scene", SAMPLED, ids=lambda scene: scene.name)
def test_every_scene_can_be_solved(scene, robot):
    """All 10,000 for the TurtleBot, on 10 cm cells; what those do not prove, on 4 cm cells.

    Cells of 10 cm close passages that are narrower than the robot and 10 to 24 cm, so "no" is not
    proof; cells of 4 cm keep every passage that is 10 cm wider than the robot.
    """
    scenes = _arrays(scene, robot=robot, n=COUNT if robot is TURTLEBOT2 else COUNT // 10)
    # A walking human leaves the way free sooner or later; the boxes do not.
    options = {"radius": robot.radius, "human": not scene.human_speed}
    unsure = _unsolved(scenes, range(len(scenes["goal"])), cell=0.1, **options)
    assert not _unsolved(scenes, unsure, cell=0.04, **options)


def test_the_showcase_can_be_solved():
    scenes = _arrays(SHOWCASE, n=1)
    assert _path_exists(scenes, 0, radius=TURTLEBOT2.radius, cell=0.05)


@pytest.mark.parametrize("robot", [TURTLEBOT2, HSR], ids=lambda robot: robot.name)
@pytest.mark.parametrize(
    "scene", [STATIC, MOVING_HUMAN, CORRIDOR, EMPTY, SHOWCASE], ids=lambda scene: scene.name
)
def test_nothing_overlaps(scene, robot):
    scenes = _arrays(scene, robot=robot)
    start, goal, human = scenes["start"][:, None], scenes["goal"][:, None], scenes["human"][:, None]
    boxes = scenes["boxes"]
    assert boxes.shape == (COUNT, scene.num_boxes, 5)
    clear = robot.radius + 0.1 - 1e-9
    assert (_box_distance(start[..., 0], start[..., 1], boxes) >= clear).all()
    assert (_box_distance(goal[..., 0], goal[..., 1], boxes) >= clear).all()
    assert (_box_distance(human[..., 0], human[..., 1], boxes) >= HUMAN_RADIUS + 0.1 - 1e-9).all()
    assert (np.hypot(*(human[..., :2] - start[..., :2]).T) >= clear + HUMAN_RADIUS).all()
    if not scene.human_speed:
        assert (np.hypot(*(human[..., :2] - goal).T) >= clear + HUMAN_RADIUS).all()


@pytest.mark.parametrize("scene", [STATIC, MOVING_HUMAN, CORRIDOR, SHOWCASE], ids=lambda s: s.name)
def test_boxes_keep_the_robot_s_width_apart(scene):
    # Distances between sampled points of the outlines are never below the true ones, and within
    # half a spacing of each: a coarse sampling suffices to see an overlap or a narrow gap.
    boxes = _arrays(scene, n=2_000)["boxes"]
    passage = 2 * TURTLEBOT2.radius + 0.1
    points = _outline(boxes)
    for first in range(scene.num_boxes):
        for second in range(scene.num_boxes):
            if first == second:
                continue
            seen = points[:, first]
            gap = _box_distance(seen[..., 0], seen[..., 1], boxes[:, None, second]).min(-1)
            assert (gap >= passage - 1e-9).all()


def test_exploring_is_static_with_half_of_the_robots_elsewhere():
    scenes, static = _arrays(EXPLORING), _arrays(STATIC)
    for key in ("goal", "human", "human_goal", "boxes"):
        np.testing.assert_array_equal(scenes[key], static[key])
    start, boxes = scenes["start"], scenes["boxes"]
    moved = (start != static["start"]).any(-1)
    assert abs(moved.mean() - 0.5) < 5 * 0.5 / math.sqrt(COUNT)
    start, boxes, human = start[moved], boxes[moved], scenes["human"][moved]
    clear = TURTLEBOT2.radius + 0.05 - 1e-9
    assert (_box_distance(start[:, None, 0], start[:, None, 1], boxes) >= clear).all()
    from_human = np.abs(start[:, :2] - human[:, :2])
    assert (np.hypot(*from_human.T) >= clear + HUMAN_RADIUS).all()
    assert (from_human <= (3.0, 2.5)).all() and (from_human.max(0) > (2.9, 2.4)).all()
    assert (np.hypot(*(start[:, :2] - scenes["goal"][moved]).T) >= 1.0).all()
    # Any heading: the mean direction of thousands is short.
    assert np.abs(np.exp(1j * start[:, 2]).mean()) < 5 / math.sqrt(moved.sum())


def test_the_walk_of_a_moving_human_is_free_of_boxes():
    scenes = _arrays(MOVING_HUMAN)
    share = np.linspace(0, 1, 200)[:, None, None]
    start, end = scenes["human"][:, None, :2], scenes["human_goal"][:, None]
    way = start + share[:, None] * (end - start)
    gap = _box_distance(way[..., 0], way[..., 1], scenes["boxes"])
    assert (gap >= HUMAN_RADIUS + 0.1 - 1e-9).all()


@pytest.mark.parametrize("scene", [STATIC, MOVING_HUMAN, EMPTY], ids=lambda scene: scene.name)
def test_start_and_goal_are_6_to_12_metres_apart(scene):
    scenes = _arrays(scene)
    distance = np.hypot(*(scenes["goal"] - scenes["start"][:, :2]).T)
    assert distance.min() >= 6.0 and distance.max() <= 12.0
    assert distance.min() < 6.05 and distance.max() > 11.95
    assert abs(distance.mean() - 9.0) < 5 * (6 / math.sqrt(12)) / math.sqrt(COUNT)
    assert (np.abs(scenes["start"][:, 2]) <= math.pi / 6).all()


@pytest.mark.parametrize("scene", [STATIC, EMPTY], ids=lambda scene: scene.name)
def test_a_standing_human_is_between_start_and_goal(scene):
    scenes = _arrays(scene)
    share = scenes["human"][:, 0] / scenes["goal"][:, 0]
    assert share.min() >= 0.3 and share.max() <= 0.7
    assert (np.abs(scenes["human"][:, 1]) <= 0.5).all()
    np.testing.assert_array_equal(scenes["human"][:, :2], scenes["human_goal"])


def test_a_moving_human_walks_from_beside_the_goal_to_beside_the_start():
    scenes = _arrays(MOVING_HUMAN)
    human, target = scenes["human"], scenes["human_goal"]
    np.testing.assert_array_equal(human[:, 0], scenes["goal"][:, 0])
    np.testing.assert_array_equal(target[:, 0], scenes["start"][:, 0])
    np.testing.assert_array_equal(human[:, 1], target[:, 1])
    np.testing.assert_array_equal(human[:, 2], np.full(COUNT, math.pi))
    assert (np.abs(human[:, 1]) <= 0.5).all()


def test_the_corridor_leads_from_the_left_into_the_three_other_arms():
    scenes = _arrays(CORRIDOR)
    start, goal = scenes["start"], scenes["goal"]
    assert (start[:, 0] <= -4.0).all() and (start[:, 0] >= -5.0).all()
    angle = np.rint(np.degrees(np.arctan2(goal[:, 1], goal[:, 0])))
    arms, counts = np.unique(angle, return_counts=True)
    assert arms.tolist() == [-90.0, 0.0, 90.0]
    # Three arms drawn evenly: five standard deviations of a binomial.
    assert (np.abs(counts - COUNT / 3) < 5 * math.sqrt(COUNT * 2 / 9)).all()
    # The boxes' inner corners frame a cross of 2.4 to 3.2 m wide corridors about the origin.
    inner = np.abs(scenes["boxes"][..., :2]) - scenes["boxes"][..., 3:]
    assert (inner >= 1.2 - 1e-9).all() and (inner <= 1.6 + 1e-9).all()


def test_the_showcase_is_one_scene():
    scenes = _sample(SHOWCASE, n=3)
    assert (scenes[0] == scenes[2]).all()
    assert (scenes == _sample(SHOWCASE, n=3, seed=1)).all()


@pytest.mark.parametrize("scene", SAMPLED, ids=lambda scene: scene.name)
def test_a_seed_fixes_the_scenes(scene):
    generators = (torch.Generator().manual_seed(seed) for seed in (3, 3, 4))
    first, again, other = (scene.sample(50, TURTLEBOT2.radius, rng) for rng in generators)
    for key in first.keys():
        assert torch.equal(first[key], again[key]), key
    assert not torch.equal(first["goal"], other["goal"])
    rows = first["goal"]
    assert torch.unique(rows, dim=0).shape == rows.shape


@pytest.mark.parametrize("scene", SAMPLED, ids=lambda scene: scene.name)
def test_sampling_draws_from_its_generator_alone(scene):
    before = torch.get_rng_state()
    scene.sample(20, TURTLEBOT2.radius, torch.Generator().manual_seed(0))
    assert torch.equal(torch.get_rng_state(), before)


@pytest.mark.parametrize("scene", [STATIC, MOVING_HUMAN, CORRIDOR], ids=lambda scene: scene.name)
def test_too_large_a_robot_is_refused(scene):
    with pytest.raises(RuntimeError, match=r"robot \(radius 3.0 m\) is too large"):
        scene.sample(4, 3.0, torch.Generator().manual_seed(0))


def test_names_are_looked_up_and_objects_pass_through():
    assert all(get_scene(name) is scene and scene.name == name for name, scene in SCENES.items())
    assert get_scene(STATIC) is STATIC
    assert get_robot("hsr") is HSR
    custom = Robot(name="custom", radius=0.2, height=0.5, mass=5.0)
    assert get_robot(custom) is custom


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"scene": "maze"}, r"Unknown scene 'maze': choose one of \['ahead', 'any_heading', "),
        ({"robot": "spot"}, r"Unknown robot 'spot': choose one of \['hsr', 'turtlebot2'\]"),
        ({"drive": "legs"}, r"Unknown drive 'legs': choose 'planar' or 'wheels'"),
    ],
)
def test_unknown_names_are_answered_with_the_known_ones(kwargs, message):
    with pytest.raises(ValueError, match=message):
        NavigationEnv(**kwargs)
