"""Commands that are late, lag and are scaled; rays that are invalid; a goal and a human reported elsewhere."""

from __future__ import annotations

import math

import pytest
import torch
from torchrl.envs.utils import check_env_specs

from envs import Faults, NavigationEnv
from envs.policy_env import make_policy_env

F64 = torch.float64
GENERATOR = torch.Generator


def drawn(faults: Faults, n: int = 1) -> torch.Tensor:
    return faults.draw(n, GENERATOR().manual_seed(0))


def executed(faults: Faults, commands: list[float]) -> list[float]:
    """Forward speeds that one base drives, after a start at rest."""
    amounts, memory = drawn(faults), torch.zeros(1, faults.memory, 2, dtype=F64)
    speeds = []
    for command in commands:
        told = torch.tensor([[command, command]], dtype=F64)
        speeds.append(faults.executed(told, memory, amounts, 0.2)[0, 0].item())
    return speeds


@pytest.mark.parametrize("latency", [0, 1, 2, 3])
def test_commands_are_executed_so_many_steps_later(latency):
    commands = [0.1, 0.2, 0.3, 0.4, 0.5]
    expected = [0.0] * latency + commands[: len(commands) - latency]
    assert executed(Faults(latency=latency), commands) == pytest.approx(expected)


def test_a_lagging_base_follows_exponentially():
    speeds = executed(Faults(lag=0.4), [1.0] * 5)
    assert speeds == pytest.approx([1 - math.exp(-0.2 * k / 0.4) for k in range(1, 6)])


def test_late_and_lagging_and_slow_together():
    late = executed(Faults(latency=2, lag=0.4, speed_scale=0.5), [1.0] * 5)
    alone = executed(Faults(lag=0.4), [1.0] * 3)
    assert late == pytest.approx([0.0, 0.0, *(0.5 * speed for speed in alone)])


def test_each_of_a_pair_of_latencies_is_as_likely():
    latency = Faults(latency=(0, 3)).draw(4000, GENERATOR().manual_seed(0))[:, 3]
    counts = torch.bincount(latency.long(), minlength=4)
    assert (abs(counts - 1000) < 5 * math.sqrt(4000 * 3 / 16)).all()


def test_rays_are_invalid_as_often_as_said_in_four_codings():
    faults = Faults(invalid_beams=0.2)
    amounts, scan = drawn(faults, 200), torch.full((200, 720), 2.5)
    coded = faults.code_invalid(scan, amounts, 4.0, GENERATOR().manual_seed(1))
    changed = coded != 2.5
    assert abs(changed.double().mean() - 0.2) < 5 * math.sqrt(0.16 / changed.numel())
    found = [coded[row][changed[row]][0].item() for row in range(200)]
    assert {"nan" if math.isnan(code) else code for code in found} == {"nan", 0.0, math.inf, 4.0}
    # One coding an episode.
    assert all(len(set(coded[row][changed[row]].nan_to_num(-1).tolist())) == 1 for row in range(9))


def test_unknown_rays_are_one_part_of_the_view():
    faults = Faults(unknown_angle=math.pi / 2)
    amounts, scan = drawn(faults, 50), torch.full((50, 720), 2.5)
    lost = faults.code_invalid(scan, amounts, 4.0, GENERATOR().manual_seed(1)) != 2.5
    assert (abs(lost.sum(1) - 180) <= 1).all()
    # Around the revolution there is one edge into it and one out.
    assert ((lost != lost.roll(1, dims=1)).sum(1) == 2).all()


def test_the_policy_s_environment_leaves_invalid_rays_out():
    faults = {"invalid_beams": 0.2, "unknown_angle": 0.5}
    env = make_policy_env(num_envs=6, num_threads=1, seed=0, faults=faults, keep_simulation=True)
    data = env.reset()
    assert not data["scan"].isfinite().all() or (data["scan"] == 0).any()
    assert data["lidar"].isfinite().all() and (data["lidar"] > 0).all()
    assert data["observation"].isfinite().all()


def test_the_goal_circles_the_true_one():
    faults = Faults(goal_drift=0.15)
    amounts = drawn(faults, 5)
    offsets = [faults.goal_offset(amounts, torch.full((5,), time).double()) for time in (0, 15, 30)]
    assert torch.allclose(offsets[0], offsets[2]) and torch.allclose(offsets[0], -offsets[1])
    assert torch.allclose(offsets[0].norm(dim=-1), torch.tensor(0.15, dtype=F64))
    env = NavigationEnv(num_envs=5, num_threads=1, seed=0, faults=faults, dtype=F64)
    clean = NavigationEnv(num_envs=5, num_threads=1, seed=0, dtype=F64)
    reported, true = env.reset(), clean.reset()
    assert ((reported["goal"] - true["goal"])[:, 0].abs() <= 0.15 + 1e-9).all()
    assert not torch.equal(reported["goal"], true["goal"])
    torch.testing.assert_close(reported["human"], true["human"])


def test_reports_of_the_human_are_noisy_and_off_to_one_side():
    faults = Faults(human_noise=0.2, human_bias=0.3)
    amounts = drawn(faults, 3)
    generator = GENERATOR().manual_seed(2)
    reports = torch.stack([faults.human_offset(amounts, generator) for _ in range(4000)])
    error = 5 * 0.2 / math.sqrt(4000)
    assert (abs(reports.mean(0).norm(dim=-1) - 0.3) < 2 * error).all()
    assert (abs(reports.std(0) - 0.2) < 5 * 0.2 / math.sqrt(8000)).all()


def test_the_human_is_lost_for_a_second_at_once():
    faults = Faults(human_lost=0.25)
    amounts = faults.draw(400, GENERATOR().manual_seed(0))
    times = [torch.full((400,), 0.2 * step + 1e-6).double() for step in range(100)]
    lost = torch.stack([faults.loses_human(amounts, time) for time in times])
    assert abs(lost.double().mean() - 0.25) < 0.02
    spells = lost.unflatten(0, (20, 5))
    assert (spells.all(1) == spells.any(1)).all()
    env = NavigationEnv(num_envs=4, num_threads=1, seed=0, faults=Faults(human_lost=1.0))
    human = env.reset()["human"]
    assert human[:, 0].tolist() == [4.0] * 4
    assert human[:, 1].tolist() == pytest.approx([math.pi] * 4)


def test_a_slow_base_gets_less_far():
    ways = []
    for faults in (None, Faults(speed_scale=0.5)):
        env = NavigationEnv(num_envs=2, scene="empty", num_threads=1, seed=0, faults=faults)
        data = env.reset()
        began = data["pose"][:, :2].clone()
        for _ in range(5):
            data = env.step(data.set("action", torch.tensor([[0.4, 0.0]] * 2)))["next"]
        ways.append((data["pose"][:, :2] - began).norm(dim=-1))
    assert torch.allclose(ways[1], 0.5 * ways[0], rtol=0.02)


EVERY = Faults(
    latency=(0, 3), lag=(0.0, 0.3), invalid_beams=(0.0, 0.2), unknown_angle=0.3,
    speed_scale=(0.9, 1.1), turn_scale=(0.9, 1.1), goal_drift=0.1, human_noise=0.1, human_lost=0.1,
)  # fmt: skip


def test_snapshots_remember_commands():
    env = NavigationEnv(num_envs=3, num_threads=1, seed=0, faults=EVERY, num_rays=30)
    check_env_specs(env)
    torch.manual_seed(0)
    rollout = env.rollout(8, break_when_any_done=False)
    # The generator goes on: what is drawn every step differs, what is remembered does not.
    restored = env.reset(rollout[:, 4].exclude("next"), set_state=True)
    assert torch.equal(restored["pending_action"], rollout["pending_action"][:, 4])
    assert torch.equal(restored["faults"], rollout["faults"][:, 4])


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ({"latency": 4}, "latency must be 0 to 3 control steps, got 4"),
        ({"lag": -1.0}, "lag must not be negative, got -1.0"),
        ({"invalid_beams": 1.5}, r"invalid_beams is a probability in \[0, 1\], got 1.5"),
        ({"human_lost": 2}, r"human_lost is a share of the time in \[0, 1\], got 2"),
        ({"unknown_angle": 90}, "unknown_angle must be from 0 to 6.283 radians, got 90"),
        ({"speed_scale": 0}, "speed_scale must be above 0 and at most 2, got 0"),
        ({"goal_drift": math.nan}, "goal_drift must be a number or a pair"),
    ],
)
def test_what_is_refused(fault, message):
    with pytest.raises(ValueError, match=message):
        Faults(**fault)
