"""Scenes from YAML files and mappings: what they draw, and what is refused in one line."""

from __future__ import annotations

import copy
import json
import math
import pickle

import pytest
import torch
import yaml
from omegaconf import OmegaConf

from envs import HUMAN_RADIUS, TURTLEBOT2, NavigationEnv, get_scene
from envs.fields import portable
from envs.scene_files import portable_scene
from torchrl_morl.evaluation import shortest_path_length
from torchrl_morl.geometry import point_box_distance, segment_box_distance

RADIUS = TURTLEBOT2.radius
FIXED = {
    "name": "room",
    "start": [0, 0, 0.5],
    "goal": [8, 1],
    "human": [4, 1.5],
    "boxes": [{"at": [3, -2], "yaw": 0.3, "size": [1.0, 0.4]}, {"at": [6, -1], "size": [1, 1]}],
}
DOOR = """
start: [0, [-0.5, 0.5], [-0.3, 0.3]]
goal: [8, [-1, 1]]
human: [[2, 6], [-1.5, 1.5]]
boxes:
  - {at: [3, [1.6, 3.0]], size: [0.2, [2, 4]]}
  - {at: [3, -2.6], size: [0.2, 4]}
"""


def _room(top):
    """Walls around the goal; the door is between 0 and the lower end of a wall of 5 m, ``top`` - 2.5."""
    return [
        {"at": [3, top], "size": [0.2, 5]},
        {"at": [3, -2.5], "size": [0.2, 5]},
        {"at": [7.5, 5], "size": [9.2, 0.2]},
        {"at": [7.5, -5], "size": [9.2, 0.2]},
        {"at": [12, 0], "size": [0.2, 10.2]},
    ]


def _draw(scene, n=64, radius=RADIUS, seed=0):
    return get_scene(scene).sample(n, radius, torch.Generator().manual_seed(seed))


def _written(folder, text, name="doorway.yaml"):
    path = folder / name
    path.write_text(text)
    return path


def test_a_fixed_scene_by_hand():
    scene = get_scene(FIXED)
    assert (scene.name, scene.num_boxes, scene.human_speed) == ("room", 2, 0.0)
    drawn = _draw(FIXED, n=3)
    for key, value in {
        "start": [0.0, 0.0, 0.5],
        "goal": [8.0, 1.0],
        "human": [4.0, 1.5, 0.0],
        "human_goal": [4.0, 1.5],
        # Half lengths and half widths.
        "boxes": [[3.0, -2.0, 0.3, 0.5, 0.2], [6.0, -1.0, 0.0, 0.5, 0.5]],
    }.items():
        assert drawn[key].dtype == torch.float64
        assert drawn[key].tolist() == [value] * 3, key


def test_a_human_who_walks_looks_where_they_go():
    walking = {**FIXED, "human": [7, 2.5], "human_goal": [1, 2.5], "human_speed": 0.4}
    drawn = _draw(walking, n=1)
    assert drawn["human"][0].tolist() == [7.0, 2.5, math.pi]
    assert drawn["human_goal"][0].tolist() == [1.0, 2.5]
    env = NavigationEnv(scene=walking, num_envs=1, num_threads=1, seed=0)
    step = env.step(env.rand_action(env.reset()))["next"]
    torch.testing.assert_close(step["human_pose"][0, :2].tolist(), [7 - 0.4 * 0.2, 2.5])
    assert _draw({**walking, "human": [7, 2.5, 1.0]}, n=1)["human"][0, 2] == 1.0


def test_ranges_are_drawn_evenly_and_by_seed(tmp_path):
    path = _written(tmp_path, DOOR)
    first, again, other = (_draw(path, seed=seed) for seed in (3, 3, 4))
    for key in first.keys():
        assert torch.equal(first[key], again[key]), key
    assert not torch.equal(first["start"], other["start"])
    start = _draw(path, n=2000)["start"]
    assert (start[:, 0] == 0).all()
    for entry, half in ((1, 0.5), (2, 0.3)):
        assert start[:, entry].abs().max() <= half < 1.05 * start[:, entry].abs().max()
        assert start[:, entry].mean().abs() < 5 * half / math.sqrt(3 * 2000)


@pytest.mark.parametrize("radius", [RADIUS, 0.35])
def test_draws_are_free_and_can_be_solved(tmp_path, radius):
    scene = {**FIXED, "human": [[2, 6], [-1.5, 1.5]], "boxes": _room([2.5, 3.5])}
    drawn = _draw(scene, n=40, radius=radius)
    human, boxes = drawn["human"][:, None, :2], drawn["boxes"]
    assert (point_box_distance(human, boxes) > HUMAN_RADIUS).all()
    door = boxes[:, 0, 1] - 2.5
    assert 2 * radius < door.min() < 2 * radius + 0.2 and door.max() > 0.9
    length = shortest_path_length(
        drawn["start"],
        drawn["goal"],
        boxes,
        radius=radius,
        human=drawn["human"],
        human_radius=HUMAN_RADIUS,
    )
    assert length.isfinite().all()


def test_walks_are_free_of_boxes():
    across = {
        **FIXED,
        "human": [[3, 5], 3],
        "human_goal": [[3, 5], -3],
        "human_speed": 0.5,
        "boxes": [{"at": [4, 0.0], "yaw": [-3, 3], "size": [0.5, 0.3]}],
    }
    drawn = _draw(across, n=500)
    walk = segment_box_distance(drawn["human"][:, :2], drawn["human_goal"], drawn["boxes"][:, 0])
    assert (walk > HUMAN_RADIUS).all()
    assert walk.min() < HUMAN_RADIUS + 0.05


def test_a_human_in_the_door_is_in_the_way_unless_they_walk():
    door = {**FIXED, "human": [3, 0.5], "boxes": _room(3.5)}
    with pytest.raises(
        ValueError, match=r"goal must have a way to it for a robot of radius 0\.177"
    ):
        _draw(door)
    assert len(_draw({**door, "human_goal": [0, 3], "human_speed": 0.5})) == 64
    with pytest.raises(ValueError, match="goal must have a way to it"):
        _draw({**door, "human_goal": [3, 0.5], "human_speed": 0.5})


def test_what_takes_a_scene_takes_a_file_a_path_a_mapping_and_a_configuration(tmp_path):
    path = _written(tmp_path, DOOR)
    mapping = OmegaConf.to_container(OmegaConf.create(DOOR))
    expected = _draw(path)
    for source in (str(path), mapping, OmegaConf.create(DOOR), get_scene(path)):
        drawn = _draw(source)
        assert all(torch.equal(expected[key], drawn[key]) for key in expected.keys())
    assert get_scene(path).name == "doorway" and get_scene(mapping).name == "custom"
    assert get_scene(path.rename(tmp_path / "other.YML")).name == "other"


def test_a_card_keeps_what_the_file_says(tmp_path):
    path = _written(tmp_path, DOOR)
    scene, kept = get_scene(path), json.loads(json.dumps(portable(path)))
    path.unlink()
    assert get_scene(kept) == scene and hash(get_scene(kept)) == hash(scene)
    assert get_scene({**kept, "goal": [8, [-1, 1.1]]}) != scene
    assert portable("static") == "static" and portable(kept) is kept and portable(scene) is scene


def test_a_described_scene_is_copied_with_its_environment(tmp_path):
    env = NavigationEnv(scene=_written(tmp_path, DOOR), num_envs=2, num_threads=1, seed=0)
    for copied in (copy.deepcopy(env), pickle.loads(pickle.dumps(env))):
        copied.set_seed(5)
        env.set_seed(5)
        assert torch.equal(copied.reset()["scene", "boxes"], env.reset()["scene", "boxes"])


def test_the_trial_draw_takes_nothing_from_a_seed(tmp_path):
    path = _written(tmp_path, DOOR)
    env = NavigationEnv(scene=path, num_envs=64, num_threads=1, seed=3)
    assert torch.equal(env.reset()["scene", "goal"], _draw(path, seed=3)["goal"])


BOX = {"at": [4, -2], "size": [1, 1]}


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"goal": ...}, r"goal is missing: \[x, y\], each a number or a range"),
        ({"goal": None}, r"goal must be \[x, y\], .* got None"),
        ({"goal": [8]}, r"goal must be \[x, y\], .* got \[8\]"),
        ({"goal": [8, "a"]}, "y of goal must be a number of metres from -100 to 100, .* got 'a'"),
        ({"goal": [8, "1e-3"]}, r"got '1e-3'\. Write 0.001\."),
        ({"goal": [8, True]}, "y of goal must be a number of metres .* got True"),
        ({"goal": [8, math.nan]}, "y of goal must be a number of metres .* got nan"),
        ({"goal": [8, [0, math.inf]]}, "y of goal must be a number of metres .* got .0, inf"),
        ({"goal": [8, [1, 0]]}, r"y of goal must be a range \[low, high\] in ascending order"),
        ({"goal": [8, [1, 2, 3]]}, r"y of goal must be a number .* got \[1, 2, 3\]"),
        ({"goal": [8000, 0]}, "x of goal must be a number of metres from -100 to 100"),
        ({"goal": [8, 10**400]}, "y of goal must be a number of metres"),
        ({"start": [0, 0]}, r"start must be \[x, y, heading\], .* got \[0, 0\]"),
        ({"start": [0, 0, 90]}, r"heading of start must be .* got 90\. 90 degrees are 1\.571\."),
        ({"human": None}, "human is missing: every scene has one"),
        ({"human": ...}, "human is missing: every scene has one"),
        ({"human": [1, 2, 3, 4]}, r"human must be \[x, y\]"),
        ({"humna": [1, 2]}, "unknown field 'humna'. Did you mean 'human'. Fields are name, start"),
        ({"human_speed": 0.5}, "human_goal is missing"),
        ({"human_goal": [1, 2]}, "human_goal needs human_speed, in m/s above 0"),
        ({"human_speed": -1}, "human_speed must be a number of m/s from 0 to 3, got -1"),
        ({"human_speed": [0, 1]}, "human_speed must be a number of m/s from 0 to 3"),
        ({"boxes": 3}, "boxes must be a list of {at, yaw, size}, got 3"),
        ({"boxes": [3]}, r"boxes\[0\] must be fields {at, yaw, size}, got 3"),
        ({"boxes": [{"at": [4, -2]}]}, r"boxes\[0\].size is missing: \[length, width\]"),
        ({"boxes": [{**BOX, "size": [1]}]}, r"boxes\[0\].size must be \[length, width\]"),
        ({"boxes": [{**BOX, "size": [-1, 1]}]}, r"length of boxes\[0\].size .* above 0 .* got -1"),
        ({"boxes": [{**BOX, "size": [1, 0]}]}, r"width of boxes\[0\].size .* above 0"),
        ({"boxes": [{**BOX, "yaw": 45}]}, r"boxes\[0\].yaw .* 45 degrees are 0\.7854\."),
        (
            {"boxes": [{**BOX, "yawn": 1}]},
            r"unknown field 'yawn' of boxes\[0\]. Did you mean 'yaw'",
        ),
        ({"boxes": [BOX, BOX]}, r"boxes\[1\] is boxes\[0\] once more"),
        ({"name": False}, "name must be text of one line, in quotes if need be, got False"),
        ({"name": "a\nb"}, "name must be text of one line"),
    ],
)
def test_fields_that_are_refused_when_read(changed, message):
    fields = {key: value for key, value in {**FIXED, **changed}.items() if value is not ...}
    with pytest.raises(ValueError, match=message) as error:
        get_scene(fields)
    assert "\n" not in str(error.value) and len(str(error.value)) < 300


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        (
            {"boxes": [{"at": [0, 0], "size": [1, 1]}]},
            r"start must be farther from boxes\[0\] than",
        ),
        ({"boxes": [BOX, {"at": [8, 1], "size": [1, 1]}]}, r"goal must be farther from boxes\[1\]"),
        ({"boxes": [{"at": [4, 1.5], "size": [1, 1]}]}, r"human must be farther from boxes\[0\]"),
        ({"goal": [0, 0]}, r"goal must be more than 0.5 m away from the start, got \[0.0, 0.0\]"),
        ({"human": [0.2, 0.1]}, "start must be farther from the human than both radii, 0.427 m"),
        ({"human": [8, 1]}, "goal must be farther from the human than both radii"),
        (
            {"human_goal": [4, -3], "human_speed": 1, "boxes": [BOX]},
            r"human_goal must be reached on a line that keeps 0.25 m from boxes\[0\]",
        ),
    ],
)
def test_places_that_are_refused_before_anything_is_driven(tmp_path, changed, message):
    path = tmp_path / "mine.yaml"
    OmegaConf.save(OmegaConf.create({**FIXED, **changed}), path)
    with pytest.raises(ValueError, match=message) as error:
        NavigationEnv(scene=path)
    assert str(error.value).startswith(f"{path}: ") and "\n" not in str(error.value)


def test_too_large_a_robot_for_the_doors_of_a_scene():
    scene = {**FIXED, "boxes": _room(3.3)}
    NavigationEnv(scene=scene)
    with pytest.raises(ValueError, match=r"a way to it for a robot of radius 0\.45 m"):
        NavigationEnv(scene=scene, robot={"radius": 0.45})


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        (
            {"goal": [[7, 8], 0], "boxes": [{"at": [7.5, 0], "size": [2, 2]}]},
            r"no scene found .* times: goal must be farther from boxes\[0\]",
        ),
        (
            {
                "goal": [[7, 8], 0],
                "boxes": _room(2.5),
            },
            "no scene found .* times: goal has no way to it",
        ),
    ],
)
def test_ranges_without_a_valid_scene_are_given_up(changed, message):
    with pytest.raises(ValueError, match=message):
        _draw({**FIXED, **changed}, n=8)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("start: [", "is not YAML: line 1, column 9: "),
        ("", "must hold fields, such as 'name: mine', got None"),
        ("- 1", r"must hold fields, .* got \[1\]"),
        ("goal: 1\ngoal: 2", "is not YAML: line 2, column 1: the field 'goal' stands here twice"),
        ("[" * 100_000, "nested too deeply"),
        ("start: !!python/object/apply:os.getcwd []", "could not determine a constructor"),
        ("start: 2024-13-45", "is not YAML: month must be in 1..12"),
        ("start: ${oc.env:HOME}", r"got '\$\{oc.env:HOME\}'"),
        ("start: &a [*a]", r"start must be \[x, y, heading\]"),
        ("a: &a [0,0,0]\nstart: [*a, *a, *a]", "unknown field 'a'"),
    ],
)
def test_files_that_are_refused(tmp_path, text, message):
    path = _written(tmp_path, text)
    with pytest.raises(ValueError, match=message) as error:
        get_scene(path)
    assert str(error.value).startswith(str(path)) and "\n" not in str(error.value)


def test_places_that_hold_no_scene(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.yaml: there is no such file"):
        get_scene(tmp_path / "none.yaml")
    with pytest.raises(ValueError, match=r"must be a file that ends in \.yaml or \.yml"):
        get_scene(tmp_path)
    with pytest.raises(ValueError, match=r"must be a file that ends in \.yaml or \.yml"):
        get_scene(_written(tmp_path, DOOR, "doorway.txt"))
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\xfa")
    with pytest.raises(ValueError, match="is not YAML: 'utf-8' codec"):
        get_scene(tmp_path / "binary.yaml")
    with pytest.raises(ValueError, match="at most 1,000,000"):
        get_scene(_written(tmp_path, "#" * 1_000_001))
    for source in (3, None, ["static"], "doorways"):
        with pytest.raises(
            ValueError,
            match=r"Unknown scene .*: choose one of \['ahead', 'any_heading', 'boxes', 'corridor'",
        ):
            get_scene(source)


def test_a_mixture_finds_files_beside_it_and_not_itself(tmp_path, monkeypatch):
    monkeypatch.chdir("/")
    hall = {"start": [0, 0, 0], "goal": [8, 0], "human": [4, 1.5]}
    (tmp_path / "hall.yaml").write_text(yaml.safe_dump(hall))
    (tmp_path / "mine.yaml").write_text("mixture: {hall.yaml: 1, static: 1}")
    assert get_scene(tmp_path / "mine.yaml").num_boxes == get_scene("static").num_boxes
    (tmp_path / "hall.yaml").write_text("mixture: {mine.yaml: 1}")
    with pytest.raises(ValueError, match=r"mine\.yaml is a mixture of itself: leave it out"):
        get_scene(tmp_path / "mine.yaml")


@pytest.fixture
def nested(tmp_path):
    """A mixture of a scene by name, one with people, and another mixture in a folder below."""
    below = tmp_path / "rooms"
    below.mkdir()
    (tmp_path / "hall.yaml").write_text("start: [0, 0, 0]\ngoal: [8, 0]\npeople: [{at: [4, 1.5]}]")
    (below / "room.yaml").write_text(yaml.safe_dump(FIXED))
    (below / "both.yaml").write_text("mixture: {room.yaml: 1, empty: 1}")
    return _written(tmp_path, "mixture: {hall.yaml: 1, static: 2, rooms/both.yaml: 3}", "mine.yaml")


def test_a_card_keeps_the_files_that_a_mixture_names(nested, monkeypatch):
    scene, kept = get_scene(nested), json.loads(json.dumps(portable_scene(nested)))
    moved = nested.parent.rename(nested.parent.with_name("elsewhere"))
    monkeypatch.chdir(moved.parent)
    assert get_scene(kept) == scene and hash(get_scene(kept)) == hash(scene)
    assert portable_scene(kept) == kept
    for key, value in _draw(kept).items():
        assert torch.equal(value, _draw(scene)[key])
    assert list(kept["mixture"]) == ["hall.yaml", "static", "rooms/both.yaml"]
    assert kept["mixture"]["static"] == 2


def test_a_mapping_may_name_files_and_hold_scenes(nested, monkeypatch):
    monkeypatch.chdir(nested.parent)
    given = {"mixture": {"hall.yaml": {"weight": 2}, "own": {"weight": 1, "scene": FIXED}}}
    kept = portable_scene(given)
    nested.with_name("hall.yaml").unlink()
    assert [one.name for one in get_scene(kept).sample.scenes] == ["hall", "room"]
    nameless = {name: value for name, value in FIXED.items() if name != "name"}
    own = {"mixture": {"own": {"weight": 1, "scene": nameless}}}
    assert [one.name for one in get_scene(own).sample.scenes] == ["own"]


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ({}, r"mixture\.own\.weight must be a weight above 0, got None"),
        ({"weight": 0, "scene": FIXED}, r"mixture\.own\.weight must be a weight above 0, got 0"),
        ({"wieght": 1}, r"unknown field 'wieght' of mixture\.own\. Did you mean 'weight'\?"),
        ({"weight": 1, "scene": {}}, r"mixture: the mapping of the scene: start is missing"),
        ({"weight": 1, "scene": 3}, r"mixture: Unknown scene 3: choose one of"),
    ],
)
def test_entries_of_a_mixture_that_are_refused(entry, message):
    with pytest.raises(ValueError, match=message) as error:
        get_scene({"mixture": {"own": entry}})
    assert "\n" not in str(error.value)


def test_a_card_cannot_keep_a_mixture_of_itself(nested):
    nested.with_name("hall.yaml").write_text("mixture: {mine.yaml: 1}")
    with pytest.raises(ValueError, match=r"mine\.yaml is a mixture of itself: leave it out"):
        portable_scene(nested)
