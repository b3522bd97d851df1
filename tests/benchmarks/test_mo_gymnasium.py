"""Beside the peers: everybody is evaluated alike, what is there is not run again, and tables say what files do."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule

from benchmarks import mo_gymnasium, mo_gymnasium_runs
from benchmarks.mo_gymnasium_runs import PEERS, TASKS, Job, Result, evaluate, measure
from benchmarks.mo_gymnasium_table import read, table
from examples.my_environment import Cart
from recipes.benchmark.fronts import Front

pytestmark = pytest.mark.benchmark

CART = "examples.my_environment:Cart-v0"
HOPPER = "mo-hopper-2obj-v5"


@pytest.fixture
def cart(monkeypatch) -> str:
    monkeypatch.setitem(TASKS, CART, ("fast", "sparing"))
    monkeypatch.setattr(Cart, "reward_dim", 2, raising=False)  # which CAPQL reads
    return CART


def made_up(job: Job, scale: float = 1.0) -> Result:
    """A result whose corners return (3, 0) and (0, 2) times the scale."""
    values = scale * np.array([[0.0, 2.0], [3.0, 0.0]])
    front = Front(TASKS[job.task], np.array([[0.0, 1.0], [1.0, 0.0]]), 10 * values, values)
    return Result(job, front, cpu_seconds=7.0, further_steps=12, episode_steps=50.0)


def test_the_evaluation_is_what_the_policy_returns(cart):
    """Against the environment itself."""
    policy = TensorDictModule(
        lambda preference: preference[..., :1], in_keys=["preference"], out_keys=["action"]
    )
    front = evaluate(Job(cart, "capql", 10, 0, preferences=3, episodes=2), policy).front
    assert front.preferences.tolist() == [[0.0, 1.0], [0.5, 0.5], [1.0, 0.0]]
    for preference, returned, discounted in zip(
        front.preferences, front.returns, front.discounted, strict=True
    ):
        sums, later = [], []
        for episode in range(2):
            env = Cart()
            env.reset(seed=mo_gymnasium_runs.EVALUATION_SEED + episode)
            env.reset()  # as TorchRL seeds: by a reset of its own
            rewards = np.array([env.step(preference[:1])[1] for _ in range(50)])
            sums.append(rewards.sum(0))
            later.append((0.99 ** np.arange(50)[:, None] * rewards).sum(0))
        np.testing.assert_allclose(returned, np.mean(sums, axis=0), rtol=1e-4)
        np.testing.assert_allclose(discounted, np.mean(later, axis=0), rtol=1e-4)


@pytest.mark.parametrize(("algorithm", "steps"), [("pd_morl", 400), ("mo_ppo", 800)])
def test_ours_train_and_are_measured(algorithm, steps, cart, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = measure(Job(cart, algorithm, steps, seed=0, preferences=3, episodes=2))
    assert result.front.returns.shape == (3, 2)
    assert result.cpu_seconds > 0
    # PD-MORL learns from its evaluations, each of two corners, three episodes of 50 steps.
    evaluated = result.further_steps - 1_000  # those that standardize observations
    assert evaluated % (2 * 3 * 50) == 0
    assert (evaluated > 0) == (algorithm == "pd_morl")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("algorithm", PEERS)
def test_peers_train_and_are_measured(algorithm, cart, tmp_path, monkeypatch):
    pytest.importorskip(
        "morl_baselines.multi_policy.gpi_pd.gpi_pd_continuous_action",
        exc_type=ImportError,
        reason="needs .venv-peers: benchmarks/README.md",
    )
    monkeypatch.chdir(tmp_path)
    result = measure(Job(cart, algorithm, 110, seed=0, preferences=3, episodes=2))
    assert result.front.returns.shape == (3, 2)
    assert np.isfinite(result.front.returns).all()
    # GPI-LS evaluates itself to choose weights, CAPQL does not.
    assert (result.further_steps > 0) == (algorithm != "capql")
    assert not list(tmp_path.iterdir())


def test_what_is_there_is_not_run_again(tmp_path):
    jobs = [Job(HOPPER, "mo_ppo", 20_000, seed, 15, 5) for seed in range(3)]
    assert mo_gymnasium.run(jobs[:1], tmp_path, made_up) == []
    assert mo_gymnasium.left_to_do(jobs, tmp_path) == jobs[1:]
    written = read(mo_gymnasium.file_of(jobs[0], tmp_path))
    assert written.job == jobs[0]
    np.testing.assert_array_equal(written.front.returns, made_up(jobs[0]).front.returns)
    longer = Job(HOPPER, "mo_ppo", 200_000, 0, 15, 5)
    assert mo_gymnasium.left_to_do([longer], tmp_path) == [longer]
    otherwise = Job(HOPPER, "mo_ppo", 20_000, 0, 15, 1)
    with pytest.raises(ValueError, match=r"--episodes 1: .* was evaluated with 5: give that"):
        mo_gymnasium.left_to_do([otherwise], tmp_path)


def test_one_that_fails_costs_no_other(tmp_path):
    jobs = [Job(HOPPER, "mo_ppo", 20_000, seed, 15, 5) for seed in range(3)]

    def measured(job: Job) -> Result:
        if job.seed == 1:
            raise RuntimeError("no\nmemory")
        return made_up(job)

    (line,) = mo_gymnasium.run(jobs, tmp_path, measured)
    assert line == f"failed: {HOPPER} mo_ppo seed 1: RuntimeError: no memory"
    assert mo_gymnasium.left_to_do(jobs, tmp_path) == [jobs[1]]


def test_the_command_says_what_it_cannot_run(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(mo_gymnasium.importlib.util, "find_spec", lambda *_: None)
    monkeypatch.setattr(mo_gymnasium, "apart", made_up)
    command = ["run", "--tasks", HOPPER, "--seeds", "4", "--output", str(tmp_path / "new")]
    mo_gymnasium.main(command)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("2 trainings run")
    assert lines[1].startswith("not run: capql, gpi-ls-one: MORL-Baselines is not installed")
    names = sorted(path.name for path in (tmp_path / "new" / HOPPER).iterdir())
    assert names == ["mo_ppo_20000_seed4.json", "pd_morl_20000_seed4.json"]
    mo_gymnasium.main(command)
    assert capsys.readouterr().out.startswith("0 trainings run")


def test_the_table_has_means_over_seeds():
    jobs = [Job(HOPPER, "capql", 20_000, seed, 2, 1) for seed in (0, 1)]
    text = table([made_up(job, scale) for job, scale in zip(jobs, (1.0, 2.0), strict=True)])
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines()]
    first = next(row for row in rows if row[:3] == ["capql", "20,000", "2"])
    volumes = [103 * 102 - 3 * 2, 106 * 104 - 6 * 4]
    assert first[3].startswith(f"{np.mean(volumes):,.0f} [{volumes[0]:,}, {volumes[1]:,}]")
    assert first[4].startswith("3.8 [")  # the mean of (3 + 2) / 2 and twice that
    assert first[6].startswith("37.5 [")
    assert first[7:] == ["7", "12"]
    velocity, height = (row for row in rows if row[2:3] in (["velocity"], ["height"]))
    assert velocity == ["capql", "20,000", "velocity", "4", "0", "45", "0", "1.00"]
    assert height == ["capql", "20,000", "height", "0", "3", "0", "30", "1.00"]


def test_a_table_mixes_no_evaluations(tmp_path, capsys):
    jobs = [Job(HOPPER, "capql", 20_000, 0, 2, 1), Job(HOPPER, "mo_ppo", 20_000, 0, 2, 5)]
    mo_gymnasium.run(jobs, tmp_path, made_up)
    with pytest.raises(SystemExit):
        mo_gymnasium.main(["table", str(tmp_path)])
    assert "was evaluated in different ways" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["", "{}", json.dumps({"job": {"task": HOPPER}, "front": {}})])
def test_a_file_that_is_no_result_is_named(text, tmp_path: Path, capsys):
    file = tmp_path / HOPPER / "mine.json"
    file.parent.mkdir()
    file.write_text(text)
    with pytest.raises(SystemExit):
        mo_gymnasium.main(["table", str(tmp_path)])
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{file} is no result of a run" in line


def test_one_process_for_each_leaves_the_generators_alone(cart):
    state = torch.random.get_rng_state()
    with pytest.raises(KeyError):  # there the task is unknown: nothing of this process is inherited
        mo_gymnasium.apart(Job(cart, "mo_ppo", 800, 0, 3, 2))
    assert torch.equal(state, torch.random.get_rng_state())
