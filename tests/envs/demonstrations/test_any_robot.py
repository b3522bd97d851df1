"""Demonstrators on robots that differ, and where nobody is."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from envs import ANY_ROBOT, NavigationEnv, get_robot
from envs.demonstrations import CircleDemonstrator, DetourDriver, demonstrated_paths, robot_radius
from envs.perception import NOBODY

ROBOTS = torch.tensor([[0.2, 0.3, 1.0, 6.3, 4.0, 0.0], [0.3, 1.0, 3.0, 6.3, 4.0, 0.0]])


def seen(human=(5.0, 0.4), goal=(9.0, 0.0)) -> TensorDict:
    data = TensorDict(
        goal=torch.tensor([goal, goal]), human=torch.tensor([human, human]), batch_size=[2]
    )
    return data.set("robot", ROBOTS)


@pytest.mark.parametrize("driver", [CircleDemonstrator, DetourDriver])
def test_actions_are_in_shares_of_each_robots_limits(driver):
    shares = driver(speed=0.6, robot="any")(seen())["action"]
    scaled = driver(speed=0.6, robot="any", scaled=True)(seen())["action"]
    torch.testing.assert_close(scaled[:, 0], 2 * shares[:, 0] - 1)
    torch.testing.assert_close(scaled[:, 1], shares[:, 1])
    speed, turn = (shares * ROBOTS[:, 1:3]).unbind(-1)
    assert (shares[:, 0] <= 1).all() and (shares[:, 1].abs() <= 1).all()
    assert speed[0] == pytest.approx(0.3, rel=1e-4) and speed[1] <= 0.6
    # The same arc, more slowly.
    one = driver(speed=0.6, robot={"radius": 0.3, "max_speed": 1.0, "max_turn_rate": 3.0})
    there = one(seen())["action"][1]
    torch.testing.assert_close(torch.stack((speed[1], turn[1])), there)


def test_a_speed_that_no_robot_has_is_refused():
    with pytest.raises(ValueError, match=r"speed must be in \(0, 1.0\] m/s, got 1.5"):
        CircleDemonstrator(speed=1.5, robot=ANY_ROBOT)


@pytest.mark.parametrize("bearing", [-2.0, -0.5, 0.5, 2.0])
def test_where_nobody_is_it_drives_to_the_goal(bearing):
    data = seen(human=NOBODY, goal=(6.0, bearing))
    turn = CircleDemonstrator()(data)["action"][0, 1]
    assert turn.sign() == torch.tensor(bearing).sign()


def test_paths_of_robots_that_differ():
    env = NavigationEnv(scene="empty", robot="any", num_envs=6, num_threads=1, seed=0)
    start = env.reset()
    radius = robot_radius(start, env.robot)
    assert radius.shape == (6,) and len(set(radius.tolist())) > 1
    assert (
        robot_radius(NavigationEnv(num_threads=1).reset(), get_robot("hsr"))
        == get_robot("hsr").radius
    )
    paths = demonstrated_paths(
        CircleDemonstrator(speed=0.4, robot="any"), start, scene="empty", robot="any", num_threads=1
    )
    assert paths["free"].all()
    step = (paths["position"][:, 1:] - paths["position"][:, :-1]).norm(dim=-1)
    fastest = start["robot"][:, 1].clamp_max(0.4) * 0.2
    assert ((step * paths["mask"][:, 1:]).amax(-1) <= fastest * 1.05).all()
