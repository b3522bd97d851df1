"""The dynamic-window planner: what it sees, and which arc it chooses."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict

from envs.perception import NOBODY
from envs.robots import HSR, TURTLEBOT2, Robot
from recipes.evaluation.dwa import DwaPlanner
from recipes.evaluation.references import make_reference
from recipes.evaluation.sweep import sweep
from torchrl_morl import PreferenceSpace

SPACE = PreferenceSpace(("core", "distance", "efficiency"), static={"core": 1.0})


def seen(
    *,
    goal: tuple[float, float] = (8.0, 0.0),
    human: tuple[float, float] = NOBODY,
    rays: dict[int, float] | None = None,
    pose: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> TensorDict:
    """One robot; ``rays`` are in degrees, of which each has two."""
    scan = torch.full((1, 720), 4.0)
    for degree, distance in (rays or {}).items():
        scan[0, [(2 * degree) % 720, (2 * degree + 1) % 720]] = distance
    return TensorDict(
        scan=scan,
        goal=torch.tensor([goal]),
        human=torch.tensor([human]),
        pose=torch.tensor([pose], dtype=torch.float64),
        batch_size=1,
    )


def drive(data: TensorDict, **arguments: float) -> tuple[float, float]:
    return tuple(DwaPlanner(**arguments)(data)["action"][0].tolist())


def test_straight_ahead_where_nothing_is_in_the_way():
    assert drive(seen()) == pytest.approx((0.5, 0.0), abs=1e-6)


@pytest.mark.parametrize("bearing", [-1.0, -0.4, 0.4, 1.0])
def test_it_turns_to_the_goal(bearing):
    _, turn = drive(seen(goal=(8.0, bearing)))
    assert math.copysign(1, turn) == math.copysign(1, bearing)


@pytest.mark.parametrize("side", [1, -1])
def test_it_passes_a_box_on_the_side_that_is_free(side):
    # A wall one metre ahead, from straight ahead to one side.
    data = seen(rays={side * degree: 1.0 / math.cos(math.radians(degree)) for degree in range(50)})
    _, turn = drive(data)
    assert turn * side < -0.05


def test_it_stops_at_what_it_cannot_pass():
    ring = seen(rays=dict.fromkeys(range(360), 0.35))
    speed, _ = drive(ring)
    assert speed == 0.0


@pytest.mark.parametrize("side", [1, -1])
def test_it_sees_how_the_human_moves(side):
    """Beside the way in both cases; it walks onto it and meets the robot, or stands there."""
    planner = DwaPlanner()

    def second(first: tuple[float, float], then: tuple[float, float]) -> torch.Tensor:
        polar = [(math.hypot(*at), math.atan2(at[1], at[0])) for at in (first, then)]
        remembered = planner(seen(human=polar[0]))["dwa"]
        return planner(seen(human=polar[1]).set("dwa", remembered))["action"][0]

    standing = second((1.2, 1.3 * side), (1.2, 1.3 * side))
    assert standing.tolist() == pytest.approx([0.5, 0.0], abs=1e-6)
    crossing = second((1.2, 1.4 * side), (1.2, 1.3 * side))  # half a metre a second
    assert not torch.allclose(crossing, standing, atol=1e-2)
    # Five metres in a step are another person.
    assert torch.equal(second((1.2, 6.3 * side), (1.2, 1.3 * side)), standing)


def test_a_human_who_stands_does_not_move_as_the_robot_turns():
    """Where they were is remembered in the world: it drives as at first sight."""
    human = torch.tensor([1.2, 1.3])
    planner, memory = DwaPlanner(), None
    for pose in ((0.0, 0.0, 0.0), (0.1, 0.02, 0.4), (0.2, 0.1, -2.9), (0.2, 0.1, 0.1)):
        off = human - torch.tensor(pose[:2])
        data = seen(human=(off.norm().item(), math.atan2(off[1], off[0]) - pose[2]), pose=pose)
        at_first_sight = planner(data.clone())["action"]
        if memory is not None:
            data["dwa"] = memory
        assert torch.equal(planner(data)["action"], at_first_sight)
        memory = data["dwa"]
        torch.testing.assert_close(memory[0, :2], human)


def test_rays_that_say_nothing_are_left_out():
    data = seen()
    data["scan"][0, ::3] = math.nan
    data["scan"][0, 1::3] = 0.0
    assert drive(data) == pytest.approx((0.5, 0.0), abs=1e-6)


def test_the_human_in_the_scan_is_the_reported_one():
    """Returns on the human walk with it; the same returns without a report stand."""
    wall = {degree: 1.0 for degree in range(-8, 9)}
    data = seen(human=(1.25, 0.0), rays=wall)
    away = data.clone().set("dwa", torch.tensor([[0.85, 0.0, 1.0]]))  # at 2 m/s
    assert drive(away) == pytest.approx((0.5, 0.0), abs=1e-6)
    assert drive(seen(rays=wall)) != pytest.approx((0.5, 0.0), abs=1e-2)


@pytest.mark.parametrize("robot", ["turtlebot2", "hsr", Robot("slow", radius=0.3, max_speed=0.25)])
def test_it_reaches_goals_past_boxes_and_human(robot):
    planner = make_reference("dwa", robot=robot)
    result = sweep(planner, SPACE, SPACE.corners()[:1], episodes=6, seed=3, robot=robot)
    assert result.mean("collision_human")[0] == 0
    assert result.mean("success")[0] >= 0.6


def test_it_knows_its_robot():
    assert DwaPlanner(robot=HSR).radius - DwaPlanner(robot=TURTLEBOT2).radius == pytest.approx(
        HSR.radius - TURTLEBOT2.radius
    )
    assert DwaPlanner(robot=Robot("slow", radius=0.2, max_speed=0.3)).speed == 0.3


def test_it_refuses_bad_arguments():
    with pytest.raises(ValueError, match=r"speed must be in \(0, 0.5\] m/s, got -0.1"):
        DwaPlanner(speed=-0.1)
    with pytest.raises(ValueError, match=r"margin must not be negative, got -0.1 m"):
        DwaPlanner(margin=-0.1)
