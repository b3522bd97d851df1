"""The value of driving straight to the goal, against closed forms and the environment."""

import math

import pytest
import torch

from envs import NavigationEnv
from envs.policy_env import OBSERVATION_SIZE
from envs.straight_drive import StraightDriveValue

OBJECTIVES = ("core", "demo", "distance", "efficiency")
FULL_SPEED = (1.0, 0.0)


def _observation(*goals: tuple[float, float]) -> torch.Tensor:
    """Goals as distance in metres and bearing; everything else is no matter."""
    observation = torch.randn(len(goals), OBSERVATION_SIZE, dtype=torch.float64)
    for row, (distance, bearing) in zip(observation, goals, strict=True):
        row[30:33] = torch.tensor([distance / 5.0, math.sin(bearing), math.cos(bearing)])
    return observation


def _action(*actions: tuple[float, float]) -> torch.Tensor:
    return torch.tensor(actions, dtype=torch.float64)


def test_values_by_hand():
    value = StraightDriveValue(OBJECTIVES, gamma=0.5, reward_scale=0.01)
    observation = _observation((0.5, 0.0), (0.5, 0.0), (0.5, math.pi))
    # Ahead to 0.4 m, one step left; at rest, two steps left; away to 0.6 m, three steps left.
    values = value(observation, _action(FULL_SPEED, (-1.0, 0.3), FULL_SPEED))
    expected = [
        [0.125 * (1 + 0.5), 0, 0, -0.1 * (1 + 0.5)],
        [0.125 * 0.5 * (1 + 0.5), 0, 0, -0.1 * (1 + 0.5 * 1.5)],
        [0.125 * (-1 + 0.5 * (1 + 0.5 + 0.25)), 0, 0, -0.1 * (1 + 0.5 * 1.75)],
    ]
    torch.testing.assert_close(values, torch.tensor(expected, dtype=torch.float64))


def test_without_discount_it_is_the_limit():
    near, limit = (StraightDriveValue(OBJECTIVES, gamma=gamma) for gamma in (1 - 1e-6, 1.0))
    inputs = _observation((8.0, 1.0)), _action((0.3, -0.2))
    torch.testing.assert_close(near(*inputs), limit(*inputs), rtol=1e-4, atol=1e-3)


def test_the_arc_is_that_of_a_unicycle():
    """The position after an action, by integration in a thousand pieces."""
    value = StraightDriveValue(OBJECTIVES, gamma=1.0)
    goals = [(3.0, 0.5), (2.0, -2.0), (4.0, 3.0)]
    actions = [(1.0, 1.0), (0.4, -0.7), (-0.5, 0.1)]
    for goal, action in zip(goals, actions, strict=True):
        speed, rate = 0.25 * (action[0] + 1), math.pi * action[1]
        x = y = 0.0
        for piece in range(1000):
            heading = rate * 0.2 * (piece + 0.5) / 1000
            x += speed * 0.2 / 1000 * math.cos(heading)
            y += speed * 0.2 / 1000 * math.sin(heading)
        after = math.hypot(goal[0] * math.cos(goal[1]) - x, goal[0] * math.sin(goal[1]) - y)
        time = -10 * (1 + (after - 0.3) / 0.1)
        values = value(_observation(goal), _action(action))[0]
        # Undiscounted, the progress of any way adds up to the same.
        assert values[0].item() == pytest.approx(125 * (goal[0] - 0.3), rel=1e-5)
        assert values[3].item() == pytest.approx(time, rel=1e-5)


@pytest.mark.parametrize("gamma", [0.9, 1.0])
def test_it_is_the_return_of_the_straight_drive_in_the_environment(gamma):
    env = NavigationEnv(scene="empty", num_envs=1, num_threads=1, seed=0)
    start = env.reset()
    start["qpos"] = torch.zeros_like(start["qpos"])
    start["human_pose"] = torch.tensor([[3.0, 5.0, 0.0]], dtype=torch.float64)
    start["scene", "goal"] = torch.tensor([[6.0, 0.0]], dtype=torch.float64)
    current = env.reset(start, set_state=True)
    steps = []
    while not current["done"].item():
        steps.append(env.step(current.set("action", torch.tensor([[0.5, 0.0]]))))
        current = steps[-1]["next"].clone()
    assert current["success"].item()

    value = StraightDriveValue(env.objectives, gamma=gamma)
    rewards = torch.cat([step["next", "reward"] for step in steps])
    for first in (3, 20, 50):  # at full speed
        rest = rewards[first:]
        returned = (gamma ** torch.arange(len(rest))[:, None] * rest).sum(0)
        distance = steps[first]["goal"][0, 0].item()
        expected = value(_observation((distance, 0.0)), _action(FULL_SPEED))[0]
        difference = (returned - expected).tolist()
        # The last step may take the robot past the radius of the goal: up to a step more.
        assert abs(difference[0]) < 12.6 and abs(difference[2]) < 10.1 and difference[1] == 0


def test_the_best_action_is_full_speed_towards_the_goal():
    value = StraightDriveValue(OBJECTIVES, gamma=0.998)
    actions = torch.cartesian_prod(*[torch.linspace(-1, 1, 21, dtype=torch.float64)] * 2)
    for bearing, best in ((0.0, (1.0, 0.0)), (0.05, (1.0, 0.15)), (1.0, (1.0, 1.0))):
        values = value(_observation((5.0, bearing)).expand(len(actions), -1), actions)
        for objective in (0, 3):
            chosen = actions[values[:, objective].argmax()]
            assert chosen[0] == best[0] and chosen[1] == pytest.approx(best[1], abs=0.051)


def test_gradients_types_and_any_batch_shape():
    value = StraightDriveValue(OBJECTIVES, gamma=0.99)
    observation = torch.zeros(2, 3, OBSERVATION_SIZE)  # at the goal, and no bearing
    action = torch.zeros(2, 3, 2, requires_grad=True)
    values = value(observation, action)
    assert values.shape == (2, 3, 4) and values.dtype == torch.float32
    values.sum().backward()
    assert action.grad.isfinite().all()
    assert not list(value.parameters()) and not value.state_dict()


@pytest.mark.parametrize("gamma", [0.0, 1.1, float("nan")])
def test_discount_is_checked(gamma):
    with pytest.raises(ValueError, match="gamma must be in"):
        StraightDriveValue(OBJECTIVES, gamma=gamma)


def test_other_objectives_earn_nothing():
    value = StraightDriveValue(("efficiency", "energy"), gamma=1.0)
    values = value(_observation((1.3, 0.0)), _action(FULL_SPEED))
    torch.testing.assert_close(values, torch.tensor([[-100.0, 0.0]], dtype=torch.float64))
