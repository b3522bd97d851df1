"""Learner benchmarks: the hand-written loop does the same maths, and the table is complete."""

from __future__ import annotations

import csv

import pytest
import torch

from benchmarks.bare_loop import BareLoop
from benchmarks.floor import MatrixRate, flops
from benchmarks.learner import available, main, ratio
from benchmarks.learner_systems import SYSTEMS
from benchmarks.ours import Ours
from benchmarks.workload import EQUAL_WORK, UPDATES, config, transitions

pytestmark = pytest.mark.benchmark

pytestmark = pytest.mark.benchmark

SMALL = ("network.num_cells=[32,32]", "replay_buffer.batch_size=64", "replay_buffer.size=200")


@pytest.fixture
def data():
    return transitions(200)


def _pair(data, *overrides):
    ours = Ours(config("compute.compile=false", *SMALL, *overrides), data)
    # After a refit the interpolator and its normalised space are not the identity.
    ours.loss.interpolator.refit([[-1.0, -5.0, -3.0], [-4.0, -1.0, -2.0], [-6.0, -3.0, -0.5]])
    return ours, BareLoop(ours, data)


def _same_batch(ours, bare):
    batch = ours.replay_buffer.sample(ours.cfg.replay_buffer.batch_size)
    ours.batch = batch
    bare.batch = (
        batch["observation"],
        batch["preference"],
        batch["action"],
        batch["next", "observation"],
        batch["next", "reward"],
        batch["next", "done"].float(),
    )


def _stages(learner, names, seed):
    torch.manual_seed(seed)
    losses = []
    for name, run in (*learner.critic_stages(), *learner.actor_stages()):
        if name in names:
            run()
            losses.append(learner.loss_value.item())
    return losses


@pytest.mark.parametrize(
    "overrides",
    [(), EQUAL_WORK, ("loss.angle_coeff_critic=0.3",), ("loss.loss_function=l2",)],
    ids=["shipped", "equal_work", "critic_angle", "squared_errors"],
)
def test_bare_loop_is_the_same_maths(data, overrides):
    """Losses of several updates from the same weights, batches and noise."""
    ours, bare = _pair(data, *overrides)
    bare._sample()
    assert [part.shape[0] for part in bare.batch] == [64] * 6
    names = {name for name, _ in (*bare.critic_stages(), *bare.actor_stages())}
    for seed in range(5):
        _same_batch(ours, bare)
        expected = _stages(ours, names - {"sample, relabel"}, seed)
        torch.testing.assert_close(
            _stages(bare, names - {"sample, relabel"}, seed), expected, rtol=2e-4, atol=1e-5
        )
    if ours.averaged is not None:
        averaged = [p for p in ours.averaged.module.parameters() if p.requires_grad]
        for one, other in zip(averaged, bare.average, strict=True):
            torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5)


def test_flops_are_those_of_the_products():
    x, weight = torch.randn(8, 5), torch.randn(3, 5, requires_grad=True)
    assert flops(lambda: (x @ weight.T).sum().backward()) == 2 * (2 * 8 * 5 * 3)
    assert MatrixRate(torch.bfloat16)() > 1e6


def test_equal_work_needs_fewer_operations_with_a_longer_delay(data):
    def operations(*overrides):
        learner = Ours(config("compute.compile=false", *SMALL, *overrides), data)
        return flops(lambda: [learner.update() for _ in range(UPDATES)])

    assert operations(*EQUAL_WORK, "optim.policy_delay=10") < operations(*EQUAL_WORK)


@pytest.mark.parametrize(
    "name", [name for name in SYSTEMS if not name.startswith(("ours", "bare"))]
)
def test_peers_learn(name, data):
    if available([name])[1]:
        pytest.skip("needs .venv-peers: benchmarks/README.md")
    learner = SYSTEMS[name].make(transitions(600), False)
    for _ in range(2):
        learner.update()
    assert learner.updates == 2


def test_ratio_compares_within_a_round():
    rates = {("a", 1): [100.0, 10.0, 50.0], ("b", 1): [50.0, 5.0, 10.0]}
    assert ratio(rates, ("a", 1), ("b", 1)) == 2.0


def test_script_prints_every_row(tmp_path, capsys):
    systems = ["ours, bfloat16", "bare loop, eager", "CAPQL"]
    command = ["--systems", *systems, "--threads", "1", "--rounds", "1", "--size", "1000"]
    main([*command, "--no-compile", "--output", str(tmp_path / "learner.csv")])
    lines = capsys.readouterr().out.splitlines()
    # Rates, and milliseconds by stage.
    for row in ("| ours, bfloat16 |", "| bare loop, eager |"):
        assert sum(line.startswith(row) for line in lines) == 2
    assert any(line.startswith(("| CAPQL |", "not run: CAPQL")) for line in lines)
    with (tmp_path / "learner.csv").open() as file:
        assert {row["system"] for row in csv.DictReader(file)} >= set(systems[:2])


def test_script_refuses_unknown_systems(capsys):
    with pytest.raises(SystemExit):
        main(["--systems", "PPO"])
    assert "unknown systems" in capsys.readouterr().err
