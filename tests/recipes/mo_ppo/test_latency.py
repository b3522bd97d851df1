"""Commands that take effect late are judged where they are done."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from envs.policy_env import make_policy_env
from recipes.mo_ppo.latency import done_at, judge_when_done, latency, rows_at
from torchrl_morl.deploy.features import observation_parts
from torchrl_morl.transforms import RewardModelReward

EPISODE = torch.tensor([[0, 0, 0, 0, 1, 1], [2, 2, 2, 2, 2, 2]])


def told_and_measured(late: int, steps: int = 6) -> torch.Tensor:
    """Motion of a robot that does a step's command ``late`` steps after it, ``[T, 10]``."""
    commands = torch.rand(steps + 4, 2, generator=torch.Generator().manual_seed(late))
    rows = [
        torch.cat((commands[t + 4 - late], *(commands[t + 4 - k] for k in range(4))))
        for t in range(steps)
    ]
    return torch.stack(rows)


@pytest.mark.parametrize("late", [0, 1, 2, 3])
@pytest.mark.parametrize("limits", [(1.0, 1.0), (0.5, 3.0)])
def test_latency_is_that_of_the_episode(late, limits):
    parts = observation_parts(observe_motion=True)
    observation = torch.zeros(2, 6, max(parts["motion"]) + 1)
    scale = torch.tensor(limits).repeat(5)
    observation[0, :4, list(parts["motion"])] = told_and_measured(late)[:4] * scale
    observation[0, 4:, list(parts["motion"])] = told_and_measured(0)[:2] * scale
    observation[1, :, list(parts["motion"])] = told_and_measured(3 - late) * scale
    data = TensorDict(
        {("next", "observation"): observation, ("collector", "traj_ids"): EPISODE},
        batch_size=[2, 6],
    )
    found = latency(data, parts, limits)
    assert found.tolist() == [[late] * 4 + [0] * 2, [3 - late] * 6]


def test_latency_of_robots_that_differ_and_lag():
    """Nothing tells of an episode that has just begun; of the others nine in ten are told."""
    observes = {"observe_robot": True, "observe_motion": True}
    env = make_policy_env(
        num_envs=32,
        num_threads=1,
        seed=3,
        scene="empty",
        robot="any",
        keep_simulation=True,
        faults={"latency": (0, 3), "lag": (0.0, 0.1), "speed_scale": (0.9, 1.1)},
        **observes,
    )
    draw, data, steps, expected = torch.Generator().manual_seed(0), env.reset(), [], []
    for _ in range(20):
        expected.append(data["faults"][:, 3].long())
        data["action"] = 0.6 * torch.rand(32, 2, generator=draw) - 0.1
        stepped = env.step(data)
        steps.append(stepped)
        data = stepped["next"].exclude("reward")
    assert not stepped["next", "done"].any()
    env.close()
    rows = torch.stack(steps, 1)
    rows["collector", "traj_ids"] = torch.arange(32)[:, None].expand(32, 20)
    found = latency(rows, observation_parts(**observes), (1.0, 1.0))
    assert (found == torch.stack(expected, 1)).float().mean() > 0.9
    assert len(found.unique()) == 4


def test_commands_are_done_in_their_own_episode():
    late = torch.tensor([[2] * 4 + [3] * 2, [1] * 6])
    assert done_at(late, EPISODE).tolist() == [[2, 3, 3, 3, 5, 5], [1, 2, 3, 4, 5, 5]]
    assert done_at(torch.zeros_like(late), EPISODE).tolist() == [[0, 1, 2, 3, 4, 5]] * 2


def test_rows_of_other_steps():
    values = torch.arange(12.0).reshape(2, 3, 2)
    step = torch.tensor([[1, 2, 2], [0, 0, 1]])
    assert rows_at(values, step).tolist() == [
        [[2, 3], [4, 5], [4, 5]],
        [[6, 7], [6, 7], [8, 9]],
    ]
    assert rows_at(values[..., 0], step).tolist() == [[2, 4, 4], [6, 6, 8]]


def test_a_command_is_judged_where_it_is_done():
    """R is the observation times the action: at steps 1 to 4, with commands 0.1 to 0.4."""
    model = TensorDictModule(
        lambda observation, action: observation * action,
        in_keys=["observation", "action"],
        out_keys=["demo_score"],
    )
    observation = torch.tensor([1.0, 2.0, 3.0, 4.0])[None, :, None].expand(3, 4, 1)
    action = torch.tensor([0.1, 0.2, 0.3, 0.4])[None, :, None].expand(3, 4, 1)
    reward = torch.zeros(3, 4, 2)
    # Of the style, and a collision.
    reward[..., 1] = 0.01 * (10 * ((observation * action).squeeze(-1) - 1) - 7)
    data = TensorDict(
        {"observation": observation, "action": action, ("next", "reward"): reward},
        batch_size=[3, 4],
    )
    step = torch.tensor([[0, 1, 2, 3], [1, 2, 3, 3], [3, 3, 3, 3]])
    judge = RewardModelReward(model, position=1, scale=10.0)
    judge_when_done(data, step, judge, reward_scale=0.01, envs_at_once=2)
    scores = torch.tensor([[0.1, 0.4, 0.9, 1.6], [0.2, 0.6, 1.2, 1.6], [0.4, 0.8, 1.2, 1.6]])
    torch.testing.assert_close(data["next", "reward"][..., 1], 0.01 * (10 * scores - 17))
    assert (data["next", "reward"][..., 0] == 0).all()
