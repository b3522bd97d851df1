"""What an environment is given wrong: one line that names the field, before anything is allocated."""

from __future__ import annotations

import math
import subprocess
import sys
import time

import pytest

from envs import NavigationEnv, Scene, get_scene
from envs.gym import NavigationGymEnv
from envs.policy_env import make_policy_env

MISTAKES = [
    ({"seed": "a"}, "seed must be a whole number, at least 0, got 'a'"),
    ({"seed": 1.5}, "seed must be a whole number, at least 0, got 1.5"),
    ({"seed": True}, "seed must be a whole number, at least 0, got True"),
    ({"seed": -1}, "seed must be at least 0, got -1"),
    ({"seed": 2**63}, "seed must be at most 9,223,372,036,854,775,806, got 9223372036854775808"),
    ({"seed": 10**5000}, "got an int of more digits than can be shown"),
    ({"device": "cuda:7"}, "device must be one that PyTorch"),
    ({"device": "tpu"}, "such as 'cpu', got 'tpu'"),
    ({"device": ""}, "such as 'cpu', got ''"),
    ({"device": 3.5}, "such as 'cpu', got 3.5"),
    ({"device": ["cpu"]}, "such as 'cpu', got ['cpu']"),
    ({"device": "meta"}, "device must be one that holds values, such as 'cpu', got 'meta'"),
    ({"num_envs": 10**9}, "num_envs must be at most 100,000, got 1000000000"),
    ({"num_envs": 10**400}, "num_envs must be at most 100,000, got "),
    ({"num_envs": None}, "num_envs must be a whole number, at least 1, got None"),
    ({"num_envs": [2]}, "num_envs must be a whole number, at least 1, got [2]"),
    ({"num_threads": 10**6}, "num_threads must be at most 4,096, got 1000000"),
    ({"num_threads": "all"}, "num_threads must be a whole number, at least 0, got 'all'"),
    ({"num_rays": 10**9}, "num_rays must be at most 100,000, got 1000000000"),
    (
        {"num_rays": 100_000, "num_envs": 100_000},
        "num_envs x num_rays must be at most 1,000,000,000, got 100000 x 100000",
    ),
    ({"max_episode_steps": 10**30}, "max_episode_steps must be at most 4,611,686,018,427"),
    ({"goal_radius": 1000}, "goal_radius must be at most 100 m, got 1000"),
    ({"goal_radius": None}, "goal_radius must be positive, got None"),
    ({"goal_radius": True}, "goal_radius must be positive, got True"),
    ({"max_range": 1e300}, "max_range must be at most 100 m, got 1e+300"),
    ({"render_width": "640"}, "render_width must be a whole number, at least 1, got '640'"),
    ({"render_height": 10**9}, "render_height must be at most 16,384, got 1000000000"),
    (
        {"from_pixels": True, "num_envs": 1000, "render_width": 16_384, "render_height": 16_384},
        "num_envs x render_width x render_height must be at most",
    ),
    ({"from_pixels": "no"}, "from_pixels must be True or False, got 'no'"),
    ({"snapshots": 1}, "snapshots must be True or False, got 1"),
    ({"report_robot": "yes"}, "report_robot must be True or False, got 'yes'"),
    ({"dtype": [1]}, "dtype must be a floating point one of PyTorch, got [1]"),
    ({"drive": "legs"}, "drive 'legs'"),
    ({"drive": None}, "drive None"),
    ({"drive": ["planar"]}, "drive ['planar']"),
    ({"scene": 7}, "Unknown scene 7: choose one of"),
    ({"scene": None}, "Unknown scene None: choose one of"),
    ({"robot": 7}, "Unknown robot 7: choose one of"),
    ({"faults": "fog"}, "faults must be"),
    ({"faults": 3}, "faults must be"),
    ({"objectives": "core"}, "objectives must be a list of names, got 'core'"),
    ({"objectives": None}, "objectives must be a list of names, got None"),
    ({"objectives": ["core", 3]}, "Unknown objective 3"),
    ({"rewards": [1]}, "rewards must be an envs.RewardConstants or a mapping, got [1]"),
    ({"rewards": {"goal_reward": "much"}}, "rewards: goal_reward must be a number above 0"),
    ({"rewards": {"collision_reward": -1e300}}, "collision_reward must be a number that float32"),
    ({"repeat_failed": "often"}, "repeat_failed must be between 0 and 1, got 'often'"),
    ({"camera": 3}, "camera must be a name or an envs.Camera, got 3"),
]


@pytest.mark.parametrize(("given", "line"), MISTAKES, ids=[line[:50] for _, line in MISTAKES])
def test_it_is_refused_by_its_name(given, line):
    started = time.perf_counter()
    with pytest.raises(ValueError) as refused:
        NavigationEnv(**given)
    shown = str(refused.value)
    assert line in shown
    assert len(shown.splitlines()) == 1 and len(shown) < 600
    assert time.perf_counter() - started < 5


def test_a_seed_that_is_given_later_is_looked_at_too():
    env = NavigationEnv(seed=0)
    with pytest.raises(ValueError, match="seed must be a whole number, at least 0, got 'a'"):
        env.set_seed("a")


@pytest.mark.parametrize("make", [make_policy_env, NavigationGymEnv])
def test_those_that_wrap_it_say_the_same(make):
    with pytest.raises(ValueError, match=r"seed must be a whole number, at least 0, got 'a'"):
        make(seed="a")
    with pytest.raises(ValueError, match=r"goal_radius must be at most 100 m, got 1000"):
        make(goal_radius=1000)


@pytest.mark.parametrize("radius", [13, 99.0])
def test_a_goal_that_reaches_the_start_is_refused_before_an_episode(radius):
    env = NavigationEnv(goal_radius=radius, seed=0)
    with pytest.raises(ValueError, match=rf"goal must be more than {radius:g} m away from the st"):
        env.reset()


BOX = {"at": [50, 50], "size": [0.1, 0.1]}
SCENE = {"start": [0, 0, 0], "goal": [8, 0], "human": [3, 5]}


@pytest.mark.parametrize(
    ("scene", "line"),
    [
        (SCENE | {"boxes": [BOX] * 10_000}, "boxes must be at most 1,000, got 10,000"),
        (
            {"start": [0, 0, 0], "goal": [8, 0], "people": [{"at": [3, 5]}] * 10_000},
            "people must be at most 100, got 10,000",
        ),
    ],
)
def test_a_scene_of_ten_thousand_is_refused_at_once(scene, line):
    started = time.perf_counter()
    with pytest.raises(ValueError, match=line):
        get_scene(scene)
    assert time.perf_counter() - started < 2


@pytest.mark.parametrize("field", ["num_boxes", "num_people"])
@pytest.mark.parametrize("count", [10_000, 10**9, "many", 1.5, math.inf])
def test_a_scene_of_ones_own_too(field, count):
    with pytest.raises(ValueError, match=rf"Scene 'mine': {field} must be "):
        Scene(**{"name": "mine", "num_boxes": 0, "sample": len, field: count})


def test_what_is_refused_takes_no_memory():
    """In a process of its own, whose address space ends a little above what it has."""
    code = """
import resource

from envs import NavigationEnv
used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + (64 << 20),) * 2)
for given in ({"num_envs": 10**9}, {"num_rays": 10**9}, {"num_threads": 10**9}, {"num_envs": 10**15}):
    try:
        NavigationEnv(**given)
    except ValueError as error:
        print("refused:", error)
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300)
    assert run.stdout.count("refused:") == 4, run.stderr
