"""The driver along a path: it comes back to it, keeps its speed, and goes on behind its end."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict
from torch.testing import assert_close

from envs.demonstrations import CircleDemonstrator, PathDriver, demonstrated_paths
from envs.policy_env import make_policy_env
from recipes.drex.tracking import disturbed
from torchrl_morl.evaluation import discrete_frechet, episode_mask


def straight(
    count: int = 2, points: int = 21, step: float = 0.1
) -> tuple[torch.Tensor, torch.Tensor]:
    """Along x, at ``step`` metres a period."""
    x = step * torch.arange(points)
    path = torch.stack((x, torch.zeros(points)), -1).expand(count, -1, -1)
    return path, torch.ones(count, points, dtype=torch.bool)


def at(x: float, y: float, heading: float, count: int = 2) -> TensorDict:
    return TensorDict(
        pose=torch.tensor([x, y, heading]).expand(count, 3).clone(), batch_size=[count]
    )


def test_on_the_path_it_drives_at_the_speed_that_was_shown():
    path, mask = straight(step=0.06)
    action = PathDriver(path, mask)(at(0.3, 0.0, 0.0))["action"]
    assert_close(action, torch.tensor([[0.3, 0.0]] * 2))


@pytest.mark.parametrize(("y", "sign"), [(0.1, -1), (-0.1, 1)])
def test_beside_the_path_it_turns_towards_it(y, sign):
    path, mask = straight()
    driver = PathDriver(path, mask, lookahead=0.2)
    action = driver(at(0.5, y, 0.0))["action"]
    # The target lies 0.2 m ahead on the path; four fifths of the bearing are gone a period later.
    bearing = math.atan2(-y, 0.2)
    assert_close(action[:, 1], torch.full((2,), bearing * 0.8 / 0.2))
    assert sign * action[0, 1] > 0


def test_a_path_that_crosses_itself_is_driven_in_its_order():
    """A figure of eight: at the crossing the nearest point is looked for ahead of the last one."""
    t = torch.linspace(0, 2 * math.pi, 80)
    path = torch.stack((t.sin(), (2 * t).sin() / 2), -1)[None]
    driver = PathDriver(path, torch.ones(1, 80, dtype=torch.bool))
    td = TensorDict(pose=torch.tensor([[0.0, 0.0, math.pi / 4]]), batch_size=[1])
    for step in range(0, 80, 2):
        td["pose"] = torch.cat((path[:, step], td["pose"][:, 2:]), -1)
        td = driver(td)
        assert abs(int(td["path_step"]) - step) <= 1


def test_behind_its_end_it_goes_straight_on():
    path, mask = straight(points=21)
    mask = mask.clone()
    mask[:, 11:] = False  # it ends at 1 m; what lies behind does not count
    driver = PathDriver(path, mask)
    td = at(1.0, 0.0, 0.0).set("path_step", torch.tensor([10, 10]))
    assert_close(driver(td)["action"], torch.tensor([[0.5, 0.0]] * 2))


def test_who_stood_still_while_showing_does_not_hold_it():
    path = torch.zeros(1, 30, 2)
    path[:, 20:, 0] = 0.1 * torch.arange(1, 11)
    action = PathDriver(path, torch.ones(1, 30, dtype=torch.bool))(at(0, 0, 0, 1))["action"]
    assert action[0, 0] >= 0.05 * math.cos(0.0) - 1e-6


@pytest.mark.parametrize("noise", [(0.0, 0.0), (0.2, 0.25)])
def test_noise_does_not_drive_it_from_what_was_demonstrated(noise):
    arguments = {"scene": "empty", "num_threads": 1}
    env = make_policy_env(num_envs=8, seed=0, keep_simulation=True, **arguments)
    begun = env.reset()
    state = begun.select(*env.base_env.state_spec.keys(True, True))
    shown = demonstrated_paths(CircleDemonstrator(), state, **arguments)
    driver = PathDriver(shown["position"], shown["mask"], scaled=True)
    data = env.rollout(
        300,
        disturbed(driver, torch.tensor(noise), seed=0),
        auto_reset=False,
        tensordict=env.reset(state, set_state=True),
        break_when_any_done=False,
        break_when_all_done=True,
    )
    mask = episode_mask(data["next", "done"])
    assert (data["next", "success"].squeeze(-1) & mask).any(-1).all()
    distance = discrete_frechet(
        data["pose"][..., :2], mask, shown["position"].float(), shown["mask"]
    )
    assert distance.max() < 0.15


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"path": torch.zeros(2, 21, 3)}, "path must have the shape"),
        ({"mask": torch.ones(2, 20, dtype=torch.bool)}, "path must have the shape"),
        ({"mask": torch.arange(21).expand(2, 21) < 1}, "at least two points"),
        ({"lookahead": 0.0}, "lookahead must be positive, got 0.0 m"),
    ],
)
def test_what_is_refused(change, message):
    path, mask = straight()
    arguments = {"path": path, "mask": mask} | change
    with pytest.raises(ValueError, match=message):
        PathDriver(**arguments)
