"""Scenes written in Python: what is wrong with them is said in one line, and nothing else is refused."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict

from envs import HUMAN_RADIUS, SCENES, NavigationEnv, Scene
from envs.catalogue import MET
from envs.scene_checks import _may_come_near, checked, problems, solvable
from torchrl_morl.evaluation import shortest_path_length
from torchrl_morl.geometry import segment_box_distance

F64 = torch.float64


def _scenes(n: int, **changed) -> TensorDict:
    """A goal 8 m ahead, a human and two boxes aside."""
    values = {
        "start": torch.zeros(n, 3, dtype=F64),
        "goal": torch.tensor([8.0, 0.0], dtype=F64).repeat(n, 1),
        "human": torch.tensor([4.0, 2.0, 0.0], dtype=F64).repeat(n, 1),
        "human_goal": torch.tensor([4.0, 2.0], dtype=F64).repeat(n, 1),
        "boxes": torch.tensor([[3.0, -2, 0, 0.5, 0.5], [6, -2, 1, 0.5, 0.5]], dtype=F64).repeat(
            n, 1, 1
        ),
    }
    return TensorDict({**values, **changed}, batch_size=[n])


def _env(change, **kwargs) -> NavigationEnv:
    def sample(n, robot_radius, generator):
        return change(_scenes(n))

    scene = Scene("mine", 2, sample, **kwargs)
    return NavigationEnv(scene=scene, num_envs=2, num_threads=1, seed=0)


def _set(key, value, row=5):
    """The field in one of the scenes."""

    def change(scenes):
        scenes[key][row] = torch.tensor(value, dtype=F64)
        return scenes

    return change


def test_a_right_one_is_left_alone():
    _env(lambda scenes: scenes).rollout(3)
    _env(lambda scenes: dict(scenes.items())).rollout(3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: s.exclude("goal"), "Scene 'mine': its sample returns no 'goal'"),
        (lambda s: None, "Scene 'mine': its sample must return a tensordict, got NoneType"),
        (lambda s: s.set("goal", s["goal"].float()), "goal must be float64, got torch.float32"),
        (lambda s: s.set("boxes", s["boxes"].float()), "boxes must be float64"),
        (
            lambda s: s.set("boxes", s["boxes"][:, :1]),
            r"boxes must be \[64, 2, 5\] of its 2 boxes \(num_boxes\), got \[64, 1, 5\]",
        ),
        (lambda s: s[:10], r"start must be \[64, 3\], got \[10, 3\]"),
        (lambda s: s.set("start", s["goal"].clone()), r"start must be \[64, 3\], got \[64, 2\]"),
        (
            lambda s: dict(s.items()) | {"goal": s["goal"].tolist()},
            "goal must be a tensor, got list",
        ),
        (
            lambda s: s.set("goal", s["goal"].clone().requires_grad_()),
            "goal must be on the CPU and without gradient",
        ),
        (_set("goal", [math.nan, 0]), r"scene 5 of 64: goal must be finite, got \[nan, 0.0\]"),
        (_set("start", [0, math.inf, 0]), "scene 5 of 64: start must be finite"),
        (_set("boxes", [[3.0, -2, math.nan, 1, 1]] * 2), r"boxes\[0\] must be finite"),
        (
            _set("boxes", [[3.0, -2, 0, 1, 1], [6, -2, 0, -1, 1]]),
            r"boxes\[1\] must have a size above 0, got \[6.0, -2.0, 0.0, -1.0, 1.0\]",
        ),
        (
            _set("goal", [6, -2]),
            r"scene 5 of 64: goal must be farther from boxes\[1\] than the rob",
        ),
        (_set("goal", [0.2, 0]), "goal must be more than 0.3 m away from the start"),
        (_set("start", [3, -2, 0]), r"start must be farther from boxes\[0\]"),
        (_set("start", [4, 2.1, 0]), "start must be farther from the human than both radii"),
        (_set("human", [3, -2.6, 0]), r"human must be farther from boxes\[0\] than the human's"),
        (_set("goal", [4.0, 2.2]), "goal must be farther from the human than both radii"),
    ],
)
def test_what_is_wrong_is_said_at_the_first_reset(change, message):
    with pytest.raises(ValueError, match=message) as error:
        _env(change).reset()
    assert str(error.value).startswith("Scene 'mine'") and "\n" not in str(error.value)


def test_later_scenes_are_checked_as_well():
    blocks = []

    def change(scenes):
        blocks.append(1)
        return _set("goal", [0.0, 0.0])(scenes) if len(blocks) == 3 else scenes

    env = _env(change)
    with pytest.raises(ValueError, match="scene 5 of 64: goal must be more than"):
        for _ in range(200):
            env.reset()
    assert len(blocks) == 3


def test_walks_through_boxes_are_refused_where_humans_walk():
    change = _set("human_goal", [2.0, -6.0])
    _env(change).reset()
    with pytest.raises(ValueError, match=r"human_goal must be reached on a line that keeps 0.25 m"):
        _env(change, human_speed=0.5).reset()
    # One who walks away from the goal is not in its way.
    away = lambda s: _set("human", [8.0, 0.1, 0.0])(s)  # noqa: E731
    _env(away, human_speed=0.5).reset()
    with pytest.raises(ValueError, match="goal must be farther from the human"):
        _env(away).reset()


def test_near_walks_are_never_missed():
    generator = torch.Generator().manual_seed(0)

    def uniform(low, high, *shape):
        return low + (high - low) * torch.rand(shape, generator=generator, dtype=F64)

    start, end = uniform(-4, 4, 50_000, 2), uniform(-4, 4, 50_000, 2)
    end[:1000], end[1000:2000, 0] = start[:1000], start[1000:2000, 0]
    box = torch.cat(
        (uniform(-1, 1, 50_000, 2), uniform(-3, 3, 50_000, 1), uniform(0.05, 1, 50_000, 2)), -1
    )
    box[500:1500, 2] = 0.0
    near = segment_box_distance(start, end, box) <= 0.25
    supposed = _may_come_near(start, end, box, 0.25)
    assert not (near & ~supposed).any()
    assert near.float().mean() > 0.9 * supposed.float().mean()


def test_the_quick_search_for_a_way_finds_no_other_ways():
    scenes = _scenes(60, boxes=torch.zeros(60, 6, 5, dtype=F64))
    low = torch.tensor([1.0, -2.0, -3.0, 0.1, 0.1], dtype=F64)
    high = torch.tensor([7.0, 2.0, 3.0, 1.5, 0.5], dtype=F64)
    generator = torch.Generator().manual_seed(0)
    scenes["boxes"] += low + (high - low) * torch.rand(60, 6, 5, generator=generator, dtype=F64)
    # Four walls around the start, and a hatch in one of them.
    walls = torch.tensor([[0.0, 1, 0, 1.1, 0.1], [0, -1, 0, 1.1, 0.1], [-1, 0, 0, 0.1, 1.1]])
    scenes["boxes"][:30, :3] = walls.double()
    scenes["boxes"][:30, 3] = torch.tensor([1.0, 0.0, 0.0, 0.1, 0.5], dtype=F64)
    scenes["boxes"][:30, 3, 4] += 0.02 * torch.arange(30)
    found = torch.zeros(60, dtype=torch.bool)
    for problem in problems(scenes, 0.177, 0.3, walks=False):
        found |= problem.scenes()
    scenes = scenes[~found]
    quick, exact = (solvable(scenes, 0.177, walks=False, exact=exact) for exact in (False, True))
    length = shortest_path_length(
        scenes["start"],
        scenes["goal"],
        scenes["boxes"],
        radius=0.177,
        human=scenes["human"],
        human_radius=HUMAN_RADIUS,
    )
    assert torch.equal(exact, length.isfinite())
    assert not (quick & ~exact).any() and 0 < quick.sum() < len(quick)
    assert quick.sum() > 0.9 * exact.sum()


# The others: tests/envs/test_layouts.py.
@pytest.mark.parametrize("name", sorted(SCENES.keys() - MET.keys() - {"everyday"}))
@pytest.mark.parametrize("radius", [0.177, 0.215])
def test_the_scenes_that_come_with_the_project_pass(name, radius):
    scene = SCENES[name]
    drawn = scene.sample(2000, radius, torch.Generator().manual_seed(1))
    kept = checked(drawn, scene, 2000, radius, 0.3)
    assert all(kept[key] is drawn[key] for key in drawn.keys())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("mine", -1, len), "Scene 'mine': num_boxes must be at least 0, got -1"),
        (("mine", 2.0, len), "num_boxes must be a whole number"),
        (("mine", True, len), "num_boxes must be a whole number"),
        (("mine", 1, None), "sample must be a function, got None"),
        (("mine", 1, len, -0.5), "human_speed must be a number of m/s, 0 or more, got -0.5"),
        (("mine", 1, len, math.nan), "human_speed must be a number"),
        (("", 1, len), "name must be text of one line"),
    ],
)
def test_scenes_that_cannot_be(arguments, message):
    with pytest.raises(ValueError, match=message):
        Scene(*arguments)
