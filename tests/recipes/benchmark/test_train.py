"""Trainings on environments that nobody of this project wrote, and on one with a known answer."""

from __future__ import annotations

import csv
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from tensordict import TensorDict

from examples.my_environment import Cart
from recipes.benchmark import train
from recipes.benchmark.fronts import Front, read_front
from recipes.benchmark.lattice import what_does_not_steer
from tests._command import run, run_here
from torchrl_morl.deploy import load_policy

pytestmark = pytest.mark.slow  # minutes on two cores

CART = "env=examples.my_environment:Cart-v0"
SHARED = (
    "compute.torch_threads=1",
    "network.num_cells=[16,16]",
    "evaluation.preferences=3",
    "evaluation.episodes=2",
    "logger.backends=[csv]",
)
PD_MORL = (
    *SHARED,
    "compute.compile=false",
    "num_envs=4",
    "preference.num_segments=2",
    "collector.total_frames=120",
    "collector.frames_per_batch=20",
    "collector.init_random_frames=40",
    "optim.updates_per_batch=2",
    "replay_buffer.batch_size=16",
    "replay_buffer.size=200",
    "evaluation.interval=60",
    "logger.interval=20",
)
MO_PPO = (
    *SHARED,
    "algorithm=mo_ppo",
    "num_envs=4",
    "collector.total_frames=96",
    "collector.frames_per_batch=32",
    "optim.batch_size=16",
    "optim.epochs=2",
    "evaluation.interval=64",
)


def trained(folder: Path, *overrides: str) -> Path:
    patch = pytest.MonkeyPatch()
    with patch.context() as context:
        context.setenv("HYDRA_FULL_ERROR", "1")
        run_here(train.main, *overrides, f"hydra.run.dir={folder}")
    return folder


@pytest.fixture(scope="module")
def pd_morl(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("pd_morl") / "run"
    return trained(folder, *PD_MORL, CART, "objectives=[fast,sparing]")


@pytest.fixture(scope="module")
def mo_ppo(tmp_path_factory) -> Path:
    return trained(tmp_path_factory.mktemp("mo_ppo") / "run", *MO_PPO, CART)


@pytest.fixture(scope="module")
def discrete(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("discrete") / "run"
    return trained(folder, *MO_PPO, "env=minecart-v0", "max_episode_steps=30")


def names(folder: Path) -> list[str]:
    return sorted(path.stem for path in folder.iterdir())


def test_what_a_training_leaves(pd_morl, mo_ppo, discrete):
    for folder, steps in ((pd_morl, [60, 120]), (mo_ppo, [64, 96]), (discrete, [64, 96])):
        expected = [f"{step:09d}" for step in steps]
        for part in ("policies", "fronts", "pictures"):
            assert names(folder / part) == expected
        last = folder / "fronts" / f"{expected[-1]}.csv"
        assert (folder / "front.csv").read_text() == last.read_text()
        info = json.loads((folder / "run.json").read_text())
        assert {"torch", "torchrl", "gymnasium", "mo-gymnasium"} <= set(info["versions"])
    assert read_front(pd_morl / "front.csv").objectives == ("fast", "sparing")
    assert read_front(mo_ppo / "front.csv").objectives == ("objective_1", "objective_2")
    assert len(read_front(discrete / "front.csv").objectives) == 3


@pytest.mark.parametrize("which", ["pd_morl", "mo_ppo"])
def test_the_front_is_what_the_saved_policy_does(which, request):
    """Against the environment itself, without vectors of environments or rollouts of TorchRL."""
    folder = request.getfixturevalue(which)
    front = read_front(folder / "front.csv")
    policy = load_policy(max((folder / "policies").iterdir()))
    gamma = policy.card["config"]["loss"]["gamma"]
    for preference, returned, discounted in zip(
        front.preferences, front.returns, front.discounted, strict=True
    ):
        sums = []
        for episode in range(2):
            cart = Cart()
            cart.reset(seed=1_000_003 + episode)  # as TorchRL seeds: by a reset of its own
            observed, _ = cart.reset()
            total, later = np.zeros(2), np.zeros(2)
            for step in range(50):
                data = TensorDict(
                    observation=torch.from_numpy(observed),
                    preference=torch.tensor(preference, dtype=torch.float32),
                )
                observed, reward, *_ = cart.step(policy.actor(data)["action"].numpy())
                total, later = total + reward, later + gamma**step * reward
            sums.append((total, later))
        mean = np.mean(sums, axis=0)
        np.testing.assert_allclose(returned, mean[0], rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(discounted, mean[1], rtol=1e-4, atol=1e-4)


def test_the_card_and_the_log_hold_the_indicators(pd_morl):
    front = read_front(pd_morl / "front.csv")
    expected = front.indicators((-100.0, -100.0))
    card = load_policy(pd_morl / "policies" / "000000120").card
    assert card["env"] == "examples.my_environment:Cart-v0"
    assert card["score"] == pytest.approx(expected["commanded_utility"], rel=1e-5)
    for name in ("hypervolume", "expected_utility", "non_dominated", "sparsity"):
        assert card["metrics"][f"eval/{name}"] == pytest.approx(expected[name], rel=1e-5)
        with (pd_morl / "log_csv" / "scalars" / "eval" / f"{name}.csv").open() as file:
            rows = list(csv.reader(file))
        assert [float(row[0]) for row in rows] == [60, 120]
        assert float(rows[-1][1]) == pytest.approx(expected[name], rel=1e-5)


def test_one_seed_gives_one_policy(pd_morl, tmp_path):
    def weights(folder: Path) -> dict[str, torch.Tensor]:
        return load_file(folder / "policies" / "000000120" / "policy.safetensors")

    again = trained(tmp_path / "again", *PD_MORL, CART, "objectives=[fast,sparing]")
    other = trained(tmp_path / "other", *PD_MORL, CART, "objectives=[fast,sparing]", "seed=1")
    one, two, three = weights(pd_morl), weights(again), weights(other)
    assert all(value.equal(two[name]) for name, value in one.items())
    assert any(not value.equal(three[name]) for name, value in one.items())


@pytest.mark.parametrize(
    ("which", "more", "steps"),
    [
        ("pd_morl", "collector.total_frames=180", [60, 120, 180]),
        ("mo_ppo", "collector.total_frames=192", [64, 96, 128, 192]),
        ("discrete", "collector.total_frames=128", [64, 96, 128]),
    ],
)
def test_goes_on_where_it_was(which, more, steps, request, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(request.getfixturevalue(which), folder)
    before = {path: path.read_bytes() for path in folder.glob("policies/*/*")}
    # The folder knows its algorithm, and its environment.
    run_here(train.main, f"resume={folder}", more)
    assert names(folder / "policies") == [f"{step:09d}" for step in steps]
    assert before == {path: path.read_bytes() for path in before}
    assert len(json.loads((folder / "run.json").read_text())["resumed"]) == 1


def test_which_algorithm_goes_on(mo_ppo, tmp_path):
    assert train.asked_for([f"resume={mo_ppo}"]) == "mo_ppo"
    assert train.asked_for([f"resume={tmp_path}"]) == "pd_morl"
    assert train.asked_for(["algorithm=mo_ppo", "env=x"]) == "mo_ppo"


BAD = [
    (
        ["env="],
        "env: '' is not registered with Gymnasium: module:Name-v0 imports what registers it.",
    ),
    (["env=mo-hoper-v5"], "env: 'mo-hoper-v5' is not registered with Gymnasium: did you mean"),
    (["env=nowhere:A-v0"], "env: nowhere:A-v0: nowhere cannot be imported"),
    (["env=CartPole-v1"], "env=CartPole-v1 has a scalar reward"),
    (["env=deep-sea-treasure-v0"], "algorithm=pd_morl needs continuous actions"),
    ([CART, "objectives=[one]"], "objectives must name the 2 entries of the reward"),
    ([CART, "objectives=[a,b,c]"], "objectives must name the 2 entries of the reward"),
    ([CART, "evaluation.reference=[0,0,0]"], "evaluation.reference must have 2 entries"),
    ([CART, "evaluation.reference=low"], "evaluation.reference must be a number"),
    ([CART, "num_envs=7"], "collector.frames_per_batch must be a multiple of num_envs, 7"),
    ([CART, "num_envs=5"], "preference.num_segments must be at most num_envs, 5, got 10"),
    ([CART, "env_kwargs={wheels: 3}"], "wheels"),
    ([CART, "algorithm=mo_pp"], "algorithm must be 'pd_morl', got 'mo_pp'"),
    ([CART, "algorithm=mo_ppo", "optim.batch_size=9999"], "optim.batch_size must lie between 1"),
    ([CART, "algorithm=mo_ppo", "optim.policy_delay=2"], "there is no field optim.policy_delay"),
    ([], "env must be given: The environment, whose reward is a vector."),
]


@pytest.mark.parametrize(("overrides", "message"), BAD)
def test_a_mistake_is_one_line_and_nothing_is_written(
    overrides, message, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr("sys.argv", ["train.py", *overrides, f"hydra.run.dir={tmp_path}/run"])
    with pytest.raises(SystemExit) as left:
        train.main()
    (line,) = capsys.readouterr().err.splitlines()
    assert left.value.code == 2
    assert line.startswith("error: ") and message in line
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("algorithm", ["pd_morl", "mo_ppo"])
def test_help_lists_the_fields_of_the_algorithm(algorithm, capsys, monkeypatch):
    monkeypatch.setattr("sys.argv", ["train.py", f"algorithm={algorithm}", "--help"])
    train.main()
    printed = capsys.readouterr().out
    assert "usage: python -m" in printed and "  env=???" in printed
    assert ("optim.policy_delay" in printed) == (algorithm == "pd_morl")
    assert ("loss.clip_epsilon" in printed) == (algorithm == "mo_ppo")


def test_objectives_that_do_not_follow_their_weights_are_named():
    weights = np.array([[1.0, 0.0], [0.5, 0.5], [0.0, 1.0]])
    # "fast" follows where it is discounted, "high" nowhere.
    discounted = np.array([[3.0, 2.0], [2.0, 1.0], [1.0, 0.0]])
    front = Front(("fast", "high"), weights, discounted[::-1].copy(), discounted)
    first, second = what_does_not_steer(front, 0.99)
    assert first.startswith("the sums of fast do not follow its weight (rank correlation -1.00)")
    assert second.startswith("the preference hardly steers high (rank correlation of weight and")
    assert what_does_not_steer(Front(("fast", "high"), weights, weights, weights), 0.99) == []


def test_a_reference_that_nothing_exceeds_is_said(tmp_path, capsys):
    trained(tmp_path / "run", *PD_MORL, CART, "evaluation.reference=1000")
    printed = capsys.readouterr().out
    assert "warning: no point exceeds evaluation.reference=[1000.0, 1000.0]" in printed


def test_five_seeds_by_one_command_and_one_summary(tmp_path):
    folder = tmp_path / "seeds"
    given = (*MO_PPO, CART, "seed=0,1,2,3,4", f"hydra.sweep.dir={folder}")
    result = run("recipes.benchmark.train", "--multirun", *given)
    assert result.returncode == 0, result.stderr
    summary = run("recipes.results.runs", folder)
    assert summary.returncode == 0, summary.stderr
    assert "| metric | all runs, n = 5 |" in summary.stdout
    row = re.search(r"\| hypervolume \| (\S+) \[(\S+), (\S+)\] \|", summary.stdout)
    middle, low, high = map(float, row.groups())
    hypervolumes = sorted(
        read_front(folder / str(job) / "front.csv").indicators((-100, -100))["hypervolume"]
        for job in range(5)
    )
    assert middle == pytest.approx(np.mean(hypervolumes[1:4]), rel=1e-4)
    assert hypervolumes[0] * 0.9999 <= low <= middle <= high <= hypervolumes[-1] * 1.0001


@pytest.mark.slow
def test_seeds_side_by_side(tmp_path):
    pytest.importorskip(
        "hydra_plugins.hydra_joblib_launcher", reason="pip install hydra-joblib-launcher"
    )
    folder = tmp_path / "seeds"
    launcher = ("hydra/launcher=joblib", "hydra.launcher.n_jobs=2", f"hydra.sweep.dir={folder}")
    result = run("recipes.benchmark.train", "--multirun", *MO_PPO, CART, "seed=0,1", *launcher)
    assert result.returncode == 0, result.stderr
    fronts = [read_front(folder / job / "front.csv") for job in ("0", "1")]
    assert not np.array_equal(fronts[0].returns, fronts[1].returns)
