"""Benchmarks: the comparison does the same work on both sides, and the table is complete."""

from __future__ import annotations

import csv
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from torchrl.envs import SerialEnv
from torchrl.envs.utils import check_env_specs, step_mdp

from benchmarks.environment import (
    MAX_EPISODE_STEPS,
    OURS,
    VARIANTS,
    Case,
    MujocoNavigationEnv,
    TorchRLLoop,
    first_elapsed,
    main,
    mujoco_envs,
    navigation_loop,
    plan,
    speed_up,
)
from envs import NavigationEnv

ROOT = Path(__file__).resolve().parent.parent
NUM_RAYS = 720


def test_both_environments_do_the_same():
    """Several episodes of the same scenes under the same actions, to their ends and beyond."""
    kwargs = {"seed": 3, "dtype": torch.float64, "max_episode_steps": 100}
    ours = NavigationEnv(num_envs=1, num_threads=1, **kwargs)
    theirs = MujocoNavigationEnv(**kwargs)
    data, other = ours.reset(), theirs.reset()
    ends = {"success": 0, "collision": 0, "truncated": 0}
    for _ in range(1000):
        # Roughly to the goal and past the human: episodes end in every way there is.
        noise = torch.randn(1, 2, dtype=torch.float64)
        human, bearing = data["human"].unbind(-1)
        aside = 4.0 * (1.5 - human).clamp_min(0.0) * -bearing.sign() * (bearing.abs() < 1.5)
        turn = 2.0 * data["goal"][:, 1] + aside + 0.5 * noise[:, 1]
        action = torch.stack((0.45 + 0.1 * noise[:, 0], turn), dim=-1)
        data = ours.step(data.set("action", action))
        other = theirs.step(other.set("action", action))
        after, their_after = data["next"], other["next"]
        assert after["qpos"].tolist() == [theirs.data.qpos.tolist()]
        torch.testing.assert_close(
            torch.cat((after["scan"], after["goal"], after["human"]), dim=-1),
            their_after["observation"],
            rtol=0,
            atol=1e-9,
        )
        torch.testing.assert_close(after["reward"], their_after["reward"], rtol=0, atol=1e-9)
        assert after["terminated"] == their_after["terminated"]
        # Ours does not call an episode truncated that ends by itself in its last step.
        assert after["done"] == their_after["done"]
        ends["success"] += int(after["success"])
        ends["collision"] += int(after["collision_human"] | after["collision_obstacle"])
        ends["truncated"] += int(after["truncated"])
        data = ours.maybe_reset(step_mdp(data))
        other = theirs.maybe_reset(step_mdp(other))
        torch.testing.assert_close(
            data["scan"], other["observation"][:, :NUM_RAYS], rtol=0, atol=1e-9
        )
    assert all(count > 0 for count in ends.values()), ends


def test_competitor_keeps_its_specs():
    env = MujocoNavigationEnv(seed=0)
    check_env_specs(env)
    ours = NavigationEnv(num_envs=1, seed=0)
    assert env.action_spec == ours.action_spec
    assert env.reward_spec == ours.reward_spec
    assert env.frame_skip == ours.frame_skip
    assert env.max_episode_steps == ours.max_episode_steps == MAX_EPISODE_STEPS


def test_first_episodes_end_one_by_one():
    num_envs = 4
    assert first_elapsed(num_envs) == [0, 75, 150, 225]
    env = SerialEnv(num_envs, mujoco_envs(num_envs))
    theirs, ours = TorchRLLoop(env), navigation_loop(num_envs, 1, snapshots=False)
    for _ in range(2):
        theirs.step()
        ours.step()
    counts = [int(single._step_count) for single in env._envs]
    assert counts == ours.env._elapsed.flatten().tolist() == [2, 77, 152, 227]
    # Only the first episode is shorter.
    env.reset()
    assert [int(single._step_count) for single in env._envs] == [0] * num_envs


def test_plan_says_why_a_case_is_left_out():
    cases, skipped = plan([1, 8, 32], serial_max=8, parallel_max=1)
    assert set(cases) | set(skipped) == {Case(v, n) for v in VARIANTS for n in (1, 8, 32)}
    assert not set(cases) & set(skipped)
    assert {n for v, n in cases if v == "MujocoEnv in SerialEnv"} == {1, 8}
    assert "--parallel-max" in skipped[Case("MujocoEnv in ParallelEnv", 8)]


def test_ratio_compares_within_a_repetition():
    other = Case("MujocoEnv", 1)
    rates = {Case(OURS, 1): [100.0, 10.0, 50.0], other: [50.0, 5.0, 10.0]}
    assert speed_up(rates, other) == 2.0


def test_script_prints_every_row(tmp_path):
    output = tmp_path / "runs" / "environment.csv"
    command = [sys.executable, "-m", "benchmarks.environment", "--sizes", "1", "2"]
    command += ["--repetitions", "2", "--seconds", "0.02", "--output", str(output)]
    result = subprocess.run(
        command, cwd=ROOT, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=120
    )
    assert result.returncode == 0, result.stderr
    lines = result.stdout.splitlines()
    for variant in VARIANTS:
        (row,) = [line for line in lines if line.startswith(variant + "  ")]
        rates = row.replace("not run", "-").removeprefix(variant).split()
        assert len(rates) == (2 if variant == OURS else 3 if "-" in rates else 4)
    assert "not run: MujocoEnv with 2: it holds one simulation" in lines
    for word in ("mujoco 4", "torchrl", "CPUs", "threads: physics"):
        assert word in result.stdout
    with output.open() as file:
        measurements = list(csv.DictReader(file))
    assert len(measurements) == 2 * (2 * len(VARIANTS) - 1)
    assert all(float(row["steps_per_second"]) > 0 for row in measurements)


@pytest.mark.parametrize("arguments", [("--sizes", "0"), ("--repetitions", "0")])
def test_script_refuses_senseless_numbers(arguments, capsys):
    with pytest.raises(SystemExit):
        main(list(arguments))
    assert "at least 1" in capsys.readouterr().err
