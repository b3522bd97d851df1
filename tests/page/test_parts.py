"""The page's parts against closed forms and numbers worked out by hand."""

from __future__ import annotations

import dataclasses
import json
import math
import subprocess

import numpy as np
import pytest
import torch

from envs import HUMAN_RADIUS, TURTLEBOT2, NavigationEnv
from recipes.objectives import OBJECTIVES, preference_colors
from recipes.page.contents import SHIPPED, contents
from tests import _any_robot as any_robot

from ._node import HERE, needs_node

pytestmark = needs_node
ROBOT = dataclasses.asdict(TURTLEBOT2)


@pytest.fixture(scope="module")
def call():
    """A function that calls a part of the page."""
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen(["node", HERE / "parts.mjs"], **pipes) as running:

        def call(name: str, *arguments):
            print(json.dumps([name, *arguments]), file=running.stdin, flush=True)
            return json.loads(running.stdout.readline())

        yield call


@pytest.fixture(scope="module")
def page():
    """What a page holds."""
    return contents(SHIPPED, ["showcase"], num_scenes=1)


def test_a_body_comes_to_its_speed_and_keeps_it(call):
    """A velocity servo of time constant tau: implicitly, 1 / (1 + h / tau) of the difference is left a step."""
    left = 1 / (1 + 0.05 / TURTLEBOT2.linear_response)
    body = call("drive", [1.0, 2.0, 0.0], [0.4, 0.0], ROBOT, 1)
    speeds = [0.4 * (1 - left**n) for n in (1, 2, 3, 4)]
    assert body["x"] == pytest.approx(1.0 + 0.05 * sum(speeds))
    assert (body["y"], body["heading"]) == (2.0, 0.0)
    assert call("drive", [0, 0, 0], [9.0, 0.0], ROBOT, 20)["vx"] == pytest.approx(0.5)  # clipped
    assert call("drive", [0, 0, 0], [-1.0, 0.0], ROBOT, 5)["vx"] == 0.0  # never backwards


def test_a_body_that_turns_drives_a_circle(call):
    body = call("drive", [0.0, 0.0, 0.0], [0.5, 1.0], ROBOT, 157)  # 31.4 s, five turns of 2 pi s
    # The radius is half a metre, so it is somewhere on that circle, give or take its start.
    assert math.hypot(body["x"], body["y"] - 0.5) == pytest.approx(0.5, abs=0.02)


HALL = {"start": [0, 0, 0], "goal": [9, 0], "human": [5, 3, 0], "human_goal": [5, 3], "boxes": []}


def test_somebody_who_grazes_the_robot_between_two_control_steps_ends_the_episode(call):
    """As in ``NavigationEnv``: tests/envs/test_substeps.py has the same walk."""
    graze = TURTLEBOT2.radius + HUMAN_RADIUS - 0.004
    walk = {"human": [graze, 0.3, 0], "human_goal": [graze, -4], "human_speed": 3.0}
    found = call("episode", {**HALL, **walk}, ROBOT, [[0, 0]] * 2)
    assert found["human"][1] == pytest.approx(-0.3)  # the step goes on to its end
    assert found["ending"] == "human" and len(found["poses"]) == 1


def test_a_corner_that_is_grazed_between_two_control_steps_ends_the_episode(call):
    """As in ``NavigationEnv``, in the same step."""
    commands = [[0.5, 0.0]] * 12
    free = call("episode", HALL, ROBOT, commands)["poses"]
    # A chord of 0.075 m of the robot is in the corner, and a step is 0.1 m: neither of its ends is.
    x, half = (free[7][0] + free[8][0]) / 2, 0.2
    box = [x, half + TURTLEBOT2.radius - 0.004, math.pi / 4, half / 2**0.5, half / 2**0.5]
    found = call("episode", {**HALL, "boxes": [box]}, ROBOT, commands)
    assert call("boxDistance", *free[7][:2], box) > TURTLEBOT2.radius
    assert call("boxDistance", *free[8][:2], box) > TURTLEBOT2.radius
    assert found["ending"] == "box" and len(found["poses"]) == 9
    sides = {"at": box[:2], "yaw": box[2], "size": [2 * box[3], 2 * box[4]]}
    scene = {"start": [0, 0, 0], "goal": [9, 0], "human": [5, 3], "boxes": [sides]}
    env = NavigationEnv(scene=scene, num_threads=1, seed=0)
    data = env.reset()
    for step in range(1, 10):
        data = env.step(data.set("action", torch.tensor(commands[:1])))["next"]
        assert data["collision_obstacle"].item() == (step == 9)


def test_the_lidar_meets_a_circle_and_a_box_where_they_are(call):
    body = {"x": 0.0, "y": 0.0, "heading": math.pi / 2}
    box = [0.0, -2.0, 0.0, 0.5, 0.25]  # behind; its near side is 1.75 m away
    ranges = call("ranges", body, ROBOT, [0.0, 3.0, 0.25], [box], 4.0)
    assert len(ranges) == 720
    assert ranges[0] == pytest.approx(2.75)
    assert ranges[360] == pytest.approx(1.75)
    assert ranges[180] == 4.0
    hit = [ray for ray, one in enumerate(ranges) if one < 4.0 and not 180 < ray < 540]
    # The tangents of a circle of 0.25 m, 3 m away: 4.78 degrees to either side, half a degree a ray.
    assert len(hit) == 2 * math.floor(math.degrees(math.asin(0.25 / 3)) / 0.5) + 1
    assert call("sectors", [4, 1, 2, 3, 0.5, 4], 3) == [1, 2, 0.5]


def test_distances_angles_and_bearings(call):
    assert call("boxDistance", 3.0, 0.0, [0, 0, 0, 1, 1]) == pytest.approx(2.0)
    assert call("boxDistance", 2.0, 2.0, [0, 0, 0, 1, 1]) == pytest.approx(math.sqrt(2))
    assert call("boxDistance", 0.5, 0.5, [0, 0, 0, 1, 1]) == 0.0
    assert call("boxDistance", 2.0, 0.0, [0, 0, math.pi / 4, 1, 1]) == pytest.approx(
        2 - math.sqrt(2)
    )
    assert call("wrapAngle", -math.pi) == math.pi
    assert call("wrapAngle", 7.0) == pytest.approx(7.0 - 2 * math.pi)
    body = {"x": 1.0, "y": 1.0, "heading": math.pi / 2}
    assert call("polar", body, 1.0, 3.0) == pytest.approx([2.0, 0.0])
    assert call("polar", body, 3.0, 1.0) == pytest.approx([2.0, -math.pi / 2])


def test_the_distance_to_a_path_grows_with_the_other_one(call):
    line = [[0, 0], [1, 0], [2, 0]]
    assert call("frechet", line, [[0, 0.5], [1, 0.5], [2, 0.5]]) == [0.5, 0.5]
    assert call("frechet", line, line[::-1])[0] == 2.0
    # Half of the way: it is 1 m from the end, and fits the first half.
    assert call("frechet", line, [[0, 0], [1, 0]]) == [1.0, 0.0]


def test_weights_stay_on_the_simplex(call):
    assert call("onSimplex", [0.2, 0.3, 0.5]) == pytest.approx([0.2, 0.3, 0.5])
    assert call("onSimplex", [2.0, 0.0, 0.0]) == [1.0, 0.0, 0.0]
    assert call("onSimplex", [0.7, 0.7, -0.1]) == pytest.approx([0.5, 0.5, 0.0])
    given = np.array([0.9, -0.3, 0.1])
    near, others = np.array(call("onSimplex", given.tolist())), np.random.default_rng(0)
    assert near.sum() == pytest.approx(1)
    assert near.min() >= 0
    away = np.linalg.norm(others.dirichlet(np.ones(3), 10_000) - given, axis=1)
    assert away.min() >= np.linalg.norm(near - given)
    assert call("withWeight", [0.5, 0.25, 0.25], 0, 0.0) == [0.0, 0.5, 0.5]
    assert call("withWeight", [1.0, 0.0, 0.0], 0, 0.4) == pytest.approx([0.4, 0.3, 0.3])


def test_mixtures_have_the_colours_of_figures(call):
    names = ["demo", "distance", "efficiency"]
    corners = [call("rgb", OBJECTIVES[name].color) for name in names]
    mixed = call("mixture", [0.2, 0.5, 0.3], corners)
    assert np.allclose(np.array(mixed) / 255, preference_colors([0.2, 0.5, 0.3], names))


def test_a_link_comes_back_and_nonsense_is_named(call):
    known = {
        "scenes": {"static": {"first_seed": 7, "scenes": [{"boxes": [0, 0]}] * 50}},
        "policies": {"one": 3, "two": 2},
        "choices": True,
        "present": {"scene": "static", "seed": 7, "policy": "one"},
    }
    state = {
        "scene": "static",
        "seed": 9,
        "preference": [0.2, 0.5, 0.3],
        "policy": "one",
        "motion": "walks",
        "moved": {"human": [1.25, -2.0], "box1": [0.0, 3.5]},
        "answers": "12=n1s2u",
        "choosing": True,
    }
    text = call("encode", state)
    assert "weights=0.2,0.5,0.3" in text
    assert text.endswith("answers=12=n1s2u&view=choices")
    assert call("decode", f"#{text}", known) == {"state": state, "refused": []}
    bad = (
        "#seed=57&policy=two&weights=1,1,1&human=1&goal=a,b&person=flies&__proto__=1&scene=toString"
    )
    answer = call("decode", bad, known)
    assert answer["state"] == {"policy": "two", "moved": {}}
    assert len(answer["refused"]) == 7
    gaps = "#human=1,&goal=,2&weights=1,,1"
    assert call("decode", gaps, known)["refused"] == ["human=1,", "goal=,2", "weights=1,,1"]
    wrong = "#answers=13&view=moon"
    assert call("decode", wrong, known)["refused"] == ["answers=13", "view=moon"]
    boxes = "#box1=1,1&box2=1,1"  # there are two
    assert call("decode", boxes, known)["refused"] == ["box2=1,1"]
    endless = "#weights=1e308,1e308,1e308"  # their sum is no number
    assert call("decode", endless, known) == {"state": {"moved": {}}, "refused": [endless[1:]]}
    none = "#answers=12&view=choices"  # a page without drives to choose from
    refused = call("decode", none, {**known, "choices": False})["refused"]
    assert refused == ["answers=12", "view=choices"]


def test_a_preference_is_for_the_objectives_of_its_policy(call, page):
    """Whoever walks is met by the other policy. It keeps the preference, if it weighs the same objectives."""
    walking = {**page["policies"]["navigation"], "walking": True}
    policies = {"stands": page["policies"]["polished_seed0"], "walks": walking}
    assert call("motion", {**page, "policies": policies}, "walks") == ["walks", [1, 0, 0]]
    policies["walks"] = {**walking, "static": {"core": 1, "demo": 1}}
    assert call("motion", {**page, "policies": policies}, "walks") == ["walks", [0.5, 0.5]]


def test_a_policy_that_knows_who_walks_and_who_stands_goes_on_with_both(call, page):
    both = {**page["policies"]["polished_seed0"], "walking": None}
    for policies in (
        {"both": both, "polished_seed0": page["policies"]["polished_seed0"]},
        {"walks": {**page["policies"]["navigation"], "walking": True}, "both": both},
    ):
        for motion in ("stands", "walks"):
            assert call("motion", {**page, "policies": policies}, motion)[0] == "both"


def test_previews_drive_the_robot_of_the_page(call, tmp_path):
    folder = any_robot.save(tmp_path / "any")
    driven, ahead = call("ahead", contents([folder], ["showcase"], num_scenes=1), [0.2, 0.5, 0.3])
    assert driven == ahead
    assert math.dist(driven[0], driven[-1]) > 0.2


def test_nobody_is_put_into_the_robot(call, page):
    x, y, _ = page["scenes"]["showcase"]["scenes"][0]["start"]
    room = page["robot"]["radius"] + 0.25 + 0.05
    assert call("put", page, [x, y])[:2] == pytest.approx([x + room, y])  # ahead of it
    assert call("put", page, [x, y - 0.1])[:2] == pytest.approx([x, y - room])
    assert call("put", page, [x + 1, y])[:2] == [x + 1, y]


def test_hands_drive_with_keys_a_stick_and_a_pointer(call):
    pose = [0.0, 0.0, 0.0]
    forward, turned, more, idle = call(
        "hand",
        pose,
        ROBOT,
        [
            {"down": ["KeyW"]},
            {"down": ["ArrowLeft"]},
            {},
            {"up": ["KeyW", "ArrowLeft"]},
        ],
    )
    assert forward == [0.5, 0]
    assert turned == pytest.approx([0.5, 0.8])  # 4 rad/s^2 for a step of 0.2 s
    assert more == pytest.approx([0.5, 1.4])  # and no further
    assert idle is None
    half, free = call("hand", pose, ROBOT, [{"stick": [0.0, -0.5]}, {"stick": [0.05, 0.05]}])
    assert half == pytest.approx([0.25, 0.0])
    assert free is None  # a stick that is let go is seldom at zero
    right, behind, there = call(
        "hand",
        pose,
        ROBOT,
        [{"target": [2.0, -0.5]}, {"target": [-2.0, 0.1]}, {"target": [0.01, 0.0]}],
    )
    assert right[0] > 0.4
    assert right[1] < 0
    assert behind == pytest.approx([0.0, 2.0])  # it turns in place
    assert there == [0, 0]


def test_what_is_kept_of_drives(call):
    def moment(x, y, ending=None, boxes=()):
        return {
            "pose": [x, y, 0.0],
            "human": [2.0, 0.0, 1.0],
            "goal": [4.0, 0.0],
            "boxes": list(boxes),
            "ending": ending,
        }

    left = [moment(0, 0), moment(2, 1.2), moment(4, 0, "goal")]
    right = [moment(0, 0), moment(2, -0.9), moment(4, 0, "goal", [[1, 2, 0.5, 0.3, 0.2]])]
    hit = [moment(0, 0), moment(1.6, 0, "human")]
    answer = call("drives", [left, hit, right])
    assert answer["said"] == [
        "Kept drive 1: 0.4 s, 1.2 m from the person, on the left.",
        "Not kept: it touched the person.",
        "Kept drive 2: 0.4 s, 0.9 m from the person, on the right.",
    ]
    lines = answer["csv"].splitlines()
    assert lines[0] == "trajectory,time,x,y,heading,human_x,human_y,goal_x,goal_y"
    assert lines[2] == "drive 1,0.2,2,1.2,0,2,0,4,0"
    assert len(lines) == 7
    assert answer["boxes"].splitlines()[1:] == ["drive 2,1,2,0.5,0.3,0.2"]
