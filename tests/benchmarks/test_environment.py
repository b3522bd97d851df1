"""Benchmarks: the comparison does the same work on both sides, and the table is complete."""

from __future__ import annotations

import copy
import csv
import functools
import subprocess
import sys
import time
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from torchrl.envs import SerialEnv
from torchrl.envs.utils import check_env_specs, step_mdp

from benchmarks.environment import Case, main, plan, speed_up, steps_per_second
from benchmarks.environment_variants import (
    OURS,
    PARALLEL,
    VARIANTS,
    BatchLoop,
    BatchRayLoop,
    EmptyEnv,
    TorchRLLoop,
    first_elapsed,
    mujoco_envs,
    navigation_env,
    navigation_loop,
)
from benchmarks.peers_environment import (
    MAX_EPISODE_STEPS,
    MAX_RANGE,
    MujocoNavigationEnv,
    RangefinderNavigationEnv,
)
from envs import NavigationEnv

pytestmark = pytest.mark.benchmark

ROOT = Path(__file__).resolve().parents[2]
NUM_RAYS = 720


def _steer(human, goal, noise):
    """Roughly to the goal and past the human: episodes end in every way there is."""
    distance, bearing = human.unbind(-1)
    aside = 4.0 * (1.5 - distance).clamp_min(0.0) * -bearing.sign() * (bearing.abs() < 1.5)
    turn = 2.0 * goal[:, 1] + aside + 0.5 * noise[:, 1]
    return torch.stack((0.45 + 0.1 * noise[:, 0], turn), dim=-1)


def test_bare_loops_scan_what_the_environment_scans():
    loop = BatchRayLoop(navigation_env(4, 1))
    for _ in range(5):
        loop.step()
    ranges, every = BatchLoop.scan(loop), loop.scan()
    every = np.where(every < 0, MAX_RANGE, every).clip(1e-3, MAX_RANGE)
    np.testing.assert_allclose(ranges, every, rtol=0, atol=1e-6)
    assert (ranges < MAX_RANGE).any()


@pytest.mark.parametrize(
    "make",
    [
        MujocoNavigationEnv,
        functools.partial(RangefinderNavigationEnv, once=True),
        RangefinderNavigationEnv,
    ],
    ids=["mj_multiRay", "rangefinders_once", "rangefinders"],
)
def test_all_environments_do_the_same(make):
    """Several episodes of the same scenes under the same actions, to their ends and beyond."""
    kwargs = {"seed": 3, "dtype": torch.float64, "max_episode_steps": 100}
    ours = NavigationEnv(num_envs=1, num_threads=1, **kwargs)
    theirs = make(**kwargs)
    # Its scans are one substep old after a step, but not after a reset.
    late = make is RangefinderNavigationEnv
    data, other = ours.reset(), theirs.reset()
    ends = {"success": 0, "collision": 0, "truncated": 0}
    for _ in range(1000):
        action = _steer(data["human"], data["goal"], torch.randn(1, 2, dtype=torch.float64))
        data = ours.step(data.set("action", action))
        other = theirs.step(other.set("action", action))
        after, their_after = data["next"], other["next"]
        assert after["qpos"].tolist() == [theirs.data.qpos.tolist()]
        observation = their_after["observation"].clone()
        if late:
            observation[:, :NUM_RAYS] = _current_scan(theirs)
        torch.testing.assert_close(
            torch.cat((after["scan"], after["goal"], after["human"]), dim=-1),
            observation,
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
        if after["done"]:
            torch.testing.assert_close(
                data["scan"], other["observation"][:, :NUM_RAYS], rtol=0, atol=1e-9
            )
    assert all(count > 0 for count in ends.values()), ends


def _current_scan(env: RangefinderNavigationEnv) -> torch.Tensor:
    """What the sensors see now, without disturbing the simulation."""
    model, data = env._backend.mj_model, copy.copy(env.data)
    mujoco.mj_forward(model, data)
    hit = np.where(data.sensordata < 0, MAX_RANGE, data.sensordata)
    return torch.from_numpy(hit.clip(1e-3, MAX_RANGE))


def test_sensors_lag_one_substep_unless_read_once():
    kwargs = {"seed": 3, "dtype": torch.float64}
    late, once = RangefinderNavigationEnv(**kwargs), RangefinderNavigationEnv(once=True, **kwargs)
    first, second = late.reset(), once.reset()
    differences = []
    for _ in range(20):
        torch.testing.assert_close(
            _current_scan(late)[None], second["observation"][:, :NUM_RAYS], rtol=0, atol=1e-9
        )
        differences.append((first["observation"] - second["observation"]).abs().max().item())
        action = torch.tensor([[0.5, 0.3]], dtype=torch.float64)
        first = late.step(first.set("action", action))["next"]
        second = once.step(second.set("action", action))["next"]
    # A reset leaves current sensors; a step leaves those of its last substep's start.
    assert differences[0] < 1e-9
    assert max(differences[1:]) > 1e-3


@pytest.mark.parametrize("make", [MujocoNavigationEnv, RangefinderNavigationEnv])
def test_competitor_keeps_its_specs(make):
    env = make(seed=0)
    check_env_specs(env)
    ours = NavigationEnv(num_envs=1, seed=0)
    assert env.action_spec == ours.action_spec
    assert env.reward_spec == ours.reward_spec
    assert env.frame_skip == ours.frame_skip
    assert env.max_episode_steps == ours.max_episode_steps == MAX_EPISODE_STEPS


def test_the_empty_environment_has_our_specs_and_resets():
    num_envs = 4
    ours = navigation_env(num_envs, 1)
    check_env_specs(EmptyEnv(ours))
    loop = TorchRLLoop(EmptyEnv(ours))
    for name in ("observation_spec", "action_spec", "reward_spec", "full_done_spec"):
        assert getattr(loop.env, name) == getattr(ours, name)
    assert set(loop.data.keys()) == set(ours.reset().keys())
    for step in range(1, MAX_EPISODE_STEPS + 1):
        loop.step()
        expected = [(step + first) % MAX_EPISODE_STEPS for first in first_elapsed(num_envs)]
        assert loop.env.elapsed.flatten().tolist() == expected
        assert not loop.data["done"].any()


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
    for name in ("one mj_multiRay", "rangefinders", "rangefinders once"):
        assert {n for v, n in cases if v == f"MujocoEnv, {name}, SerialEnv"} == {1, 8}
        assert "--parallel-max" in skipped[Case(f"MujocoEnv, {name}, ParallelEnv", 8)]


def test_processes_of_their_own_are_left_out_of_processor_time():
    _, skipped = plan([2], serial_max=2, parallel_max=2, clock="cpu")
    reason = "its processes have clocks of their own (--clock)"
    assert {case.variant for case, why in skipped.items() if why == reason} == set(PARALLEL)


def test_processor_time_does_not_count_waiting():
    class Sleeper:
        def step(self):
            time.sleep(0.02)

        def close(self):
            pass

    wall, cpu = (steps_per_second(Sleeper(), 1, 0.001, clock) for clock in ("wall", "cpu"))
    assert wall < 50 < cpu


def test_ratio_compares_within_a_repetition():
    other = Case("MujocoEnv, one mj_multiRay", 1)
    rates = {Case(OURS, 1): [100.0, 10.0, 50.0], other: [50.0, 5.0, 10.0]}
    assert speed_up(rates, other) == 2.0


@pytest.mark.slow
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
    assert "not run: MujocoEnv, one mj_multiRay with 2: it holds one simulation" in lines
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
