"""The value of driving straight to the goal, against closed forms and the environment."""

import math

import pytest
import torch

from envs import NavigationEnv
from envs.straight_drive import StraightDriveValue
from torchrl_morl.deploy.features import OBSERVATION_SIZE

OBJECTIVES = ("core", "demo", "distance", "efficiency")


def _at(*distances: float) -> torch.Tensor:
    """Observations at these distances of the goal; everything else is no matter."""
    observation = torch.randn(len(distances), OBSERVATION_SIZE, dtype=torch.float64)
    observation[:, 30] = torch.tensor(distances) / 5.0
    return observation


def test_values_by_hand():
    # 0.1 m a step, 12.5 points of progress and -10 of time: two steps, a quarter of a step, none.
    value = StraightDriveValue(OBJECTIVES, gamma=0.5, reward_scale=0.01)
    quarter = (1 - 0.5**0.25) / 0.5
    expected = [
        [0.125 * 1.5, 0.0, 0.0, -0.1 * 1.5],
        [0.125 * quarter, 0.0, 0.0, -0.1 * quarter],
        [0.0, 0.0, 0.0, 0.0],
    ]
    expected = torch.tensor(expected, dtype=torch.float64)
    torch.testing.assert_close(value(_at(0.5, 0.325, 0.1)), expected, rtol=1e-5, atol=1e-6)


def test_it_solves_the_bellman_equation_of_the_straight_way():
    value = StraightDriveValue(OBJECTIVES, gamma=0.97)
    here, next_ = value(_at(7.3, 2.0)), value(_at(7.2, 1.9))
    reward = torch.tensor([12.5, 0.0, 0.0, -10.0], dtype=torch.float64)
    torch.testing.assert_close(here, reward + 0.97 * next_, rtol=1e-5, atol=1e-4)


def test_without_discount_it_is_the_limit():
    near, limit = (StraightDriveValue(OBJECTIVES, gamma=gamma) for gamma in (1 - 1e-6, 1.0))
    observation = _at(8.0)
    torch.testing.assert_close(near(observation), limit(observation), rtol=1e-4, atol=1e-3)


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
        difference = (returned - value(_at(steps[first]["goal"][0, 0].item()))[0]).tolist()
        # The last step may take the robot past the radius of the goal: up to a step more.
        assert abs(difference[0]) < 12.6 and abs(difference[2]) < 10.1 and difference[1] == 0


def test_gradients_types_and_any_batch_shape():
    value = StraightDriveValue(OBJECTIVES, gamma=0.99)
    observation = torch.zeros(2, 3, OBSERVATION_SIZE, requires_grad=True)
    values = value(observation)
    assert values.shape == (2, 3, 4) and values.dtype == torch.float32
    values.sum().backward()
    assert observation.grad.isfinite().all()
    assert not list(value.parameters()) and not value.state_dict()


@pytest.mark.parametrize("gamma", [0.0, 1.1, math.nan])
def test_discount_is_checked(gamma):
    with pytest.raises(ValueError, match="gamma must be in"):
        StraightDriveValue(OBJECTIVES, gamma=gamma)


def test_other_objectives_earn_nothing():
    values = StraightDriveValue(("efficiency", "energy"), gamma=1.0)(_at(1.3))
    expected = torch.tensor([[-100.0, 0.0]], dtype=torch.float64)
    torch.testing.assert_close(values, expected, rtol=1e-5, atol=1e-5)
