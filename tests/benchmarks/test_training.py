"""Benchmarks of a training: shares add up, pieces run once, and curves are written and read."""

from __future__ import annotations

import csv
import time

import pytest
import torch
from tensordict import TensorDict

from benchmarks import collecting, quality_peers, time_to_quality, training_step
from benchmarks import test_units as units
from torchrl_morl.deploy import load_policy
from torchrl_morl.modules import RewardModel

pytestmark = pytest.mark.benchmark

TINY = (
    "compute.compile=false",
    "network.num_cells=[16,16]",
    "env.num_envs=4",
    "env.max_episode_steps=4",
    "collector.frames_per_batch=24",
    "collector.init_random_frames=24",
    "replay_buffer.size=200",
    "replay_buffer.batch_size=16",
    "optim.updates_per_batch=2",
    "evaluation.episodes=2",
    "logger.backends=[csv]",
)


def test_watch_counts_what_runs_inside_for_itself():
    watch = training_step.Watch()
    assert watch.running == training_step.SET_UP
    watch.set_up()
    inner = watch.around(lambda: time.sleep(0.02), lambda parent: f"in {parent}")
    with watch("outer"):
        inner()
        time.sleep(0.01)
    watch.stop()
    assert set(watch.seconds) == {training_step.SET_UP, training_step.OTHER, "outer", "in outer"}
    # A sleep may last longer than asked for, never less.
    assert watch.seconds["in outer"] > 0.019
    assert watch.seconds["outer"] > 0.009
    assert watch.calls == {"outer": 1, "in outer": 1}


def test_training_step_prints_every_share(tmp_path, capsys):
    output = tmp_path / "shares.md"
    training_step.main(["--frames", "72", "--output", str(output), *TINY])
    text = output.read_text()
    assert text.strip() in capsys.readouterr().out
    for part in (
        "collect",
        "collect, simulation",
        "replay: sample, relabel",
        "critic: gradients",
        "critic: Adam",
        "actor: gradients",
        "actor: Adam",
        "soft update, average",
        "evaluate, simulation",
        "log, save",
    ):
        assert f"| {part} |" in text
    shares = [
        float(line.split("|")[4].rstrip(" %")) for line in text.splitlines() if " % |" in line
    ]
    assert sum(shares) == pytest.approx(100, abs=1)
    assert "72 environment steps and 4 updates" in text


@pytest.mark.slow
def test_collecting_in_other_processes(tmp_path, capsys):
    output = tmp_path / "collecting.md"
    options = ["--rounds", "1", "--frames", "96", "--batches", "1", "--threads", "1"]
    collecting.main([*options, "--output", str(output), *TINY], num_envs=4, steps=3)
    text = output.read_text()
    assert text.strip() in capsys.readouterr().out
    rows = [line.split("|")[1:4] for line in text.splitlines() if "PPO" in line or "MORL," in line]
    assert [name.strip() for name, *_ in rows] == [
        "PD-MORL, 1 torch thread",
        "PD-MORL, 1 torch thread, overlapping",
        "MO-PPO, collecting, one process",
        "MO-PPO, collecting, two processes",
    ]
    assert all(float(seconds) > 0 and float(ratio) > 0 for _, seconds, ratio in rows)
    assert float(rows[0][2]) == float(rows[2][2]) == 1


def test_curve_of_ours_is_written_and_read(tmp_path, capsys):
    path = tmp_path / "ours.csv"
    command = ["train", "ours", "--seed", "3", "--output", str(path), "--pd-morl", *TINY]
    time_to_quality.main([*command, "collector.total_frames=72", "evaluation.interval=24"])
    with path.open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["steps"]) for row in rows] == [48, 72]
    # To a tenth of a second, which a fast machine does not need for the second.
    assert 0 <= float(rows[0]["seconds"]) <= float(rows[1]["seconds"])
    assert {"success distance", "success efficiency", "success balanced"} <= rows[0].keys()
    capsys.readouterr()
    picture = tmp_path / "curves.png"
    time_to_quality.main(["report", str(path), "--success", "0", "--plot", str(picture)])
    assert "| ours | 3 | " in capsys.readouterr().out
    assert picture.exists()
    with pytest.raises(FileExistsError):
        time_to_quality.main(command)


def test_ours_stops_at_a_time(tmp_path):
    path = tmp_path / "small.csv"
    command = ["train", "ours", "--label", "small", "--minutes", "0", "--output", str(path)]
    time_to_quality.main([*command, "--pd-morl", *TINY, "evaluation.interval=24"])
    with path.open() as file:
        (row,) = csv.DictReader(file)
    assert (row["system"], row["steps"]) == ("small", "48")


def test_time_to_a_success_is_that_of_the_first_evaluation():
    rows = [
        {"success": value, "seconds": 60 * minute, "cpu_seconds": 30 * minute}
        for minute, value in enumerate(("20", "96", "80", "99"))
    ]
    assert time_to_quality.minutes_to(rows, 95) == 1
    assert time_to_quality.minutes_to(rows, 97, clock="cpu") == 1.5
    assert time_to_quality.minutes_to(rows, 100) is None


def _need(module: str) -> None:
    # It asks for more than .venv should hold: benchmarks/README.md gives it one of its own.
    name = f"morl_baselines.multi_policy.{module}"
    pytest.importorskip(
        name, exc_type=ImportError, reason="needs .venv-peers: benchmarks/README.md"
    )


@pytest.mark.parametrize("system", time_to_quality.PEERS)
def test_peers_train_on_the_navigation_task(system, tmp_path):
    _need("gpi_pd.gpi_pd_continuous_action")
    path = tmp_path / "peer.csv"
    command = ["train", system, "--minutes", "0.01", "--every", "0.01", "--output", str(path)]
    saved = tmp_path / "saved"
    if system in time_to_quality.CAPQL:
        command += ["--save", str(saved)]
    time_to_quality.main([*command, "--pd-morl", *TINY])
    with path.open() as file:
        (row,) = csv.DictReader(file)
    if system in time_to_quality.CAPQL:
        (folder,) = saved.iterdir()
        assert int(folder.name) == int(row["steps"])
        policy = load_policy(folder)
        assert policy.preference_space.objectives == ("core", "distance", "efficiency")
        assert (
            policy.card["config"]["env"]["scene"] == "static" and policy.card["config"]["seed"] == 0
        )


@pytest.mark.parametrize("system", sorted({time_to_quality.OURS, *time_to_quality.PEERS}))
def test_save_refuses_what_it_cannot_and_what_is_there(system, tmp_path, capsys):
    """Before anything is written, and before a peer is needed."""
    output = tmp_path / "new.csv"
    command = ["train", system, "--output", str(output), "--save", str(tmp_path)]
    with pytest.raises(SystemExit):
        time_to_quality.main(command)
    expected = "is not overwritten" if system in time_to_quality.CAPQL else "--save is for capql"
    assert expected in capsys.readouterr().err
    assert not output.exists()


def test_the_policy_of_capql_is_saved_as_one_of_ours(tmp_path):
    _need("capql.capql")
    model = RewardModel(in_features=36 + 2, num_cells=(8,))
    env = quality_peers.make_env(0, 0.01, reward_model=model)
    peer = quality_peers.Peer("capql", env, seed=0, gamma=0.99)
    peer.save(tmp_path / "policy", {"score": 0.0})
    policy = load_policy(tmp_path / "policy")
    assert policy.preference_space.objectives == ("core", "demo", "distance", "efficiency")
    data = TensorDict(
        observation=torch.randn(5, 36), preference=policy.preference_space.sample(5), batch_size=5
    )
    torch.testing.assert_close(
        policy.actor(data.clone())["action"], peer.actor(data.clone())["action"]
    )


def test_units_run():
    class Once:
        """Calls what it is given, as pytest-benchmark does many times."""

        def __call__(self, function, *args, **kwargs):
            return function(*args, **kwargs)

        def pedantic(self, function, **kwargs):
            return function()

    cfg = units.config(*TINY)
    ours = units.Ours(cfg, units.transitions(200))
    ours.update()
    deployed = units.load_policy(units.POLICY)
    names = [name for name in dir(units) if name.startswith("test_")]
    assert len(names) >= 7
    for name in names:
        test = getattr(units, name)
        arguments = {"benchmark": Once(), "cfg": cfg, "ours": ours, "deployed": deployed}
        wanted = test.__code__.co_varnames[: test.__code__.co_argcount]
        test(**{argument: arguments[argument] for argument in wanted})
