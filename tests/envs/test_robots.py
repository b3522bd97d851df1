"""Robots of one's own: files, mappings and objects, and what is refused in one line."""

from __future__ import annotations

import math

import pytest
import torch
from omegaconf import OmegaConf

from envs import HSR, ROBOTS, NavigationEnv, Robot, get_robot

TEXT = "radius: 0.25\nmax_speed: 0.8\nlidar_fov: 4.712389\n"


def test_fields_that_are_left_out_have_defaults(tmp_path):
    path = tmp_path / "cart.yaml"
    path.write_text(TEXT)
    robot = get_robot(path)
    assert robot == Robot("cart", radius=0.25, max_speed=0.8, lidar_fov=4.712389)
    assert robot == Robot("cart", 0.25, 0.5, 5.0, 0.8, math.pi, 0.0, 4.712389)
    for source in (str(path), OmegaConf.create(TEXT + "name: cart"), robot):
        assert get_robot(source) == robot
    assert get_robot({"radius": 0.25}).name == "custom"
    path.write_text(TEXT + "name: trolley")
    assert get_robot(path).name == "trolley"


def test_the_robots_that_come_with_the_project_are_within_their_limits():
    for name, robot in ROBOTS.items():
        assert get_robot(name) is robot
    assert get_robot(HSR) is HSR


def test_an_environment_takes_the_file(tmp_path):
    path = tmp_path / "cart.yaml"
    path.write_text(TEXT)
    env = NavigationEnv(robot=path, scene="empty", num_envs=1, num_threads=1, seed=0)
    assert env.robot.radius == 0.25
    torch.testing.assert_close(env.action_spec.space.high, torch.tensor([[0.8, math.pi]]))
    # It reaches its own speed: 0.16 m a step.
    data = env.reset()
    for _ in range(4):
        data = env.step(data.set("action", torch.tensor([[0.8, 0.0]])))["next"]
    last = data["pose"][0, :2].clone()
    data = env.step(data.set("action", torch.tensor([[0.8, 0.0]])))["next"]
    assert abs((data["pose"][0, :2] - last).norm().item() - 0.16) < 1e-6


def test_541_beams_over_270_degrees_are_720_a_revolution():
    robot = Robot("cart", radius=0.25, lidar_fov=math.radians(270))
    # A box around everything: every beam in view meets it.
    scene = {"start": [0, 0, 0], "goal": [3, 0], "human": [0, 3]}
    walls = [(0, 5, 20, 1), (0, -5, 20, 1), (5, 0, 1, 20), (-5, 0, 1, 20)]
    scene["boxes"] = [{"at": [x, y], "size": [a, b]} for x, y, a, b in walls]
    env = NavigationEnv(
        robot=robot, scene=scene, num_rays=720, max_range=10.0, num_envs=1, num_threads=1
    )
    scan = env.reset()["scan"][0]
    seen = scan < 10.0
    assert seen.sum() == 541
    assert seen[:271].all() and seen[-270:].all()
    assert abs(scan[0].item() - 4.5) < 1e-6


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"radius": ...}, "radius is missing, in metres"),
        ({"radius": -1}, "radius must be a number above 0 and at most 2 metres, got -1"),
        ({"radius": 25}, "radius must be a number above 0 and at most 2 metres, got 25"),
        ({"radius": "0.2"}, r"radius must be a number .* got '0.2'\. Write 0.2\."),
        ({"radius": math.nan}, "radius must be a number .* got nan"),
        ({"radius": True}, "radius must be a number .* got True"),
        ({"radius": 10**400}, "radius must be a number"),
        ({"mass": None}, "mass must be a number above 0 and at most 1000 kilograms, got None"),
        ({"max_speed": 0}, "max_speed must be a number above 0 and at most 10 m/s, got 0"),
        (
            {"lidar_fov": 270},
            r"lidar_fov must be .* 6.283 radians, got 270\. 270 degrees are 4.712\.",
        ),
        (
            {"max_turn_rate": 180},
            r"max_turn_rate must be .* 12.57 rad/s, got 180\. 180 degrees are 3.142\.",
        ),
        (
            {"lidar_offset": 0.3},
            "lidar_offset must be a number of metres within the radius of 0.25",
        ),
        ({"lidar_offset": [0.1]}, "lidar_offset must be a number"),
        ({"linear_response": 0}, "linear_response must be a number above 0 and at most 5 seconds"),
        ({"wheel_radius": math.inf}, "wheel_radius must be a number above 0"),
        ({"radious": 0.2}, "unknown field 'radious'. Did you mean 'radius'. Fields are name, rad"),
        ({"name": 3}, "name must be text of one line"),
    ],
)
def test_fields_that_are_refused(tmp_path, changed, message):
    fields = {"radius": 0.25, **changed}
    fields = {key: value for key, value in fields.items() if value is not ...}
    with pytest.raises(ValueError, match=message) as error:
        get_robot(fields)
    assert "\n" not in str(error.value)
    if all(len(str(value)) < 100 for value in fields.values()):  # YAML writes no longer integers
        path = tmp_path / "cart.yaml"
        OmegaConf.save(OmegaConf.create(fields), path)
        with pytest.raises(ValueError, match=message) as error:
            get_robot(path)
        assert str(error.value).startswith(f"{path}: ")


def test_objects_are_held_to_the_same_limits():
    with pytest.raises(ValueError, match="robot 'cart': radius must be a number above 0"):
        Robot("cart", radius=0.0)
    with pytest.raises(ValueError, match="name must be text of one line, got 3"):
        Robot(3, radius=0.2)


def test_places_that_hold_no_robot(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.yaml: there is no such file"):
        get_robot(tmp_path / "none.yaml")
    for source in (3, None, ["hsr"], "spot"):
        with pytest.raises(ValueError, match=r"Unknown robot .*: choose one of \['hsr'"):
            get_robot(source)
