"""References without learning: what they drive, and that a sweep can drive them."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict

from envs import NavigationEnv
from envs.policy_env import make_policy_env
from envs.robots import HSR, TURTLEBOT2
from recipes.evaluation import references
from recipes.evaluation.references import REFERENCES, OrcaPlanner, make_reference
from recipes.evaluation.sweep import sweep
from torchrl_morl import PreferenceSpace

SPACE = PreferenceSpace(NavigationEnv.objectives, static={"core": 1.0})
needs_pyrvo = pytest.mark.skipif(not references._has_pyrvo, reason="pyrvo is not installed")


@pytest.mark.parametrize(
    "name", [*sorted(set(REFERENCES) - {"orca"}), pytest.param("orca", marks=needs_pyrvo)]
)
def test_a_sweep_drives_every_reference(name):
    preferences = SPACE.corners()
    result = sweep(make_reference(name), SPACE, preferences, episodes=2, seed=7, scene="empty")
    assert result.mean("success").shape == (2,)
    # One behaviour for all preferences.
    assert torch.equal(result.metrics["path_length"][0], result.metrics["path_length"][1])
    # The human stands on the straight way in some scenes.
    assert name == "straight" or result.mean("success")[0] == 1


def test_unknown_reference_is_refused():
    with pytest.raises(ValueError, match="unknown reference 'teleport': choose among"):
        make_reference("teleport")


def test_arguments_reach_the_reference():
    assert make_reference("demonstrator", radius=0.8, robot="hsr").radius == 0.8
    with pytest.raises(ValueError, match="radius must be positive"):
        make_reference("demonstrator", radius=-1.0)


def scene(
    *,
    pose: tuple[float, float, float] = (0.0, 0.0, 0.0),
    goal: tuple[float, float] = (8.0, 0.0),
    human: tuple[float, float] = (100.0, 0.0),
    box: tuple[float, ...] = (100.0, 50.0, 0.0, 0.3, 0.3),
    before: tuple[float, ...] | None = None,
) -> TensorDict:
    """One robot; the goal is polar, everything else in metres."""
    data = TensorDict(
        pose=torch.tensor([pose], dtype=torch.float64),
        human_pose=torch.tensor([[*human, 0.0]], dtype=torch.float64),
        goal=torch.tensor([goal]),
        scene=TensorDict(boxes=torch.tensor([[box]], dtype=torch.float64), batch_size=1),
        batch_size=1,
    )
    if before is not None:
        data["orca"] = torch.tensor([before], dtype=torch.float64)
    return data


def drive(data: TensorDict, **arguments: float) -> tuple[float, float]:
    return tuple(OrcaPlanner(**arguments)(data)["action"][0].tolist())


@needs_pyrvo
def test_orca_drives_straight_where_nothing_is_in_the_way():
    assert drive(scene()) == pytest.approx((0.5, 0.0), abs=1e-6)
    assert drive(scene(), speed=0.3) == pytest.approx((0.3, 0.0), abs=1e-6)


@needs_pyrvo
@pytest.mark.parametrize("bearing", [-2.0, -0.3, 0.3, 2.0])
def test_orca_turns_towards_the_goal_and_slows_down_for_it(bearing):
    # Wherever the robot stands and looks in the world.
    speed, turn = drive(scene(pose=(3.0, -2.0, 2.5), goal=(8.0, bearing)))
    assert math.copysign(1, turn) == math.copysign(1, bearing)
    assert speed == pytest.approx(0.5 * max(math.cos(bearing), 0) ** 2, abs=1e-5)


@needs_pyrvo
@pytest.mark.parametrize("side", [1, -1])
def test_orca_evades_a_human_on_the_side_that_is_free(side):
    data = scene(human=(1.2, 0.2 * side), before=(-0.1, 0.0, 1.2, 0.2 * side))
    _, turn = drive(data)
    assert turn * side < -0.05


@needs_pyrvo
@pytest.mark.parametrize("side", [1, -1])
def test_orca_evades_a_box_on_the_side_that_is_free(side):
    data = scene(box=(0.9, 0.3 * side, 0.0, 0.3, 0.3), before=(-0.1, 0.0, 100.0, 0.0))
    _, turn = drive(data)
    assert turn * side < -0.05


@needs_pyrvo
def test_orca_sees_how_the_human_moves():
    # Beside the robot's path in both cases; it walks onto it and meets the robot, or stands there.
    human = (1.5, -1.2)
    crossing = drive(scene(human=human, before=(-0.1, 0.0, 1.5, -1.3)))
    standing = drive(scene(human=human, before=(-0.1, 0.0, *human)))
    assert standing == pytest.approx((0.5, 0.0), abs=1e-6)
    assert crossing != pytest.approx(standing, abs=1e-2)
    # A jump is another episode, which begins at rest, and not a speed.
    jumped = drive(scene(human=human, before=(-0.1, 0.0, 1.5, -9.0)))
    assert jumped == drive(scene(human=human))


@needs_pyrvo
def test_orca_stops_at_what_it_cannot_pass():
    wall = scene(box=(0.4, 0.0, 0.0, 0.1, 5.0), before=(-0.1, 0.0, 100.0, 0.0))
    speed, _ = drive(wall)
    assert speed < 0.1


@needs_pyrvo
def test_orca_reaches_goals_past_boxes_and_human_without_touching():
    result = sweep(make_reference("orca"), SPACE, SPACE.corners()[:1], episodes=8, seed=3)
    assert result.mean("success")[0] >= 0.8
    assert result.mean("collision_human")[0] == 0


@pytest.mark.parametrize("name", [pytest.param("orca", marks=needs_pyrvo), "dwa"])
def test_planners_read_nothing_that_their_in_keys_do_not_name(name):
    planner = make_reference(name)
    env = make_policy_env(num_envs=3, seed=0, keep_simulation=True)
    data = env.reset()
    seen = data.select(*planner.in_keys)
    assert torch.equal(planner(seen)["action"], planner(data)["action"])
    assert data["action"].abs().max() <= 1


@needs_pyrvo
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"speed": 0.6}, r"speed must be in \(0, 0.5\] m/s, got 0.6"),
        ({"margin": -0.1}, "margin must not be negative, got -0.1 m"),
        ({"human_horizon": 0.0}, "human_horizon must be positive, got 0.0 s"),
        ({"box_horizon": -1.0}, "box_horizon must be positive, got -1.0 s"),
    ],
)
def test_orca_refuses_bad_arguments(arguments, message):
    with pytest.raises(ValueError, match=message):
        OrcaPlanner(**arguments)


@needs_pyrvo
def test_orca_knows_the_size_of_its_robot():
    assert OrcaPlanner(robot=HSR).radius - OrcaPlanner(robot=TURTLEBOT2).radius == pytest.approx(
        HSR.radius - TURTLEBOT2.radius
    )


def test_orca_without_its_library_says_what_to_install(monkeypatch):
    monkeypatch.setattr(references, "_has_pyrvo", False)
    with pytest.raises(ImportError, match=r"pip install -c constraints\.txt pyrvo"):
        make_reference("orca")
