"""Faults that every episode draws: training over all of them at once."""

from __future__ import annotations

import math

import pytest
import torch
from omegaconf import OmegaConf
from torchrl.envs.utils import check_env_specs

from envs import Faults, NavigationEnv
from envs.faults import NUM_AMOUNTS, get_faults
from envs.policy_env import make_policy_env
from recipes.training import task
from tests._drex import config

EVERY = Faults(
    range_noise=(0.0, 0.05), dropout=(0.02, 0.1), velocity_noise=(0.0, 0.05), latency=(0, 1)
)
F64 = torch.float64


def make_env(**kwargs) -> NavigationEnv:
    return NavigationEnv(**{"num_threads": 1, "dtype": F64, "seed": 0, **kwargs})


# --- amounts


def test_every_episode_draws_within_the_ranges():
    amounts = EVERY.draw(4000, torch.Generator().manual_seed(0))
    assert amounts.shape == (4000, NUM_AMOUNTS) and amounts.dtype == F64
    for column, (low, high) in enumerate([(0.0, 0.05), (0.02, 0.1), (0.0, 0.05)]):
        drawn = amounts[:, column]
        assert low <= drawn.min() < drawn.max() <= high
        # A uniform distribution: its mean and its standard deviation.
        error = (high - low) / math.sqrt(12 * 4000)
        assert abs(drawn.mean() - (low + high) / 2) < 5 * error
        assert abs(drawn.std() - (high - low) / math.sqrt(12)) < 5 * error
    assert set(amounts[:, 3].tolist()) == {0.0, 1.0}
    assert abs(amounts[:, 3].mean() - 0.5) < 5 * 0.5 / math.sqrt(4000)
    # Each fault by itself.
    correlation = torch.corrcoef(amounts[:, :4].T) - torch.eye(4)
    assert correlation.abs().max() < 5 / math.sqrt(4000)


def test_faults_that_are_numbers_are_not_drawn():
    generator = torch.Generator().manual_seed(0)
    before = generator.get_state()
    amounts = Faults(0.03, 0.2, 0.01, 1).draw(3, generator)
    assert amounts[:, :4].tolist() == [[0.03, 0.2, 0.01, 1.0]] * 3
    assert torch.equal(generator.get_state(), before)
    mixed = Faults(range_noise=0.03, latency=(0, 1)).draw(50, generator)
    assert (mixed[:, 0] == 0.03).all() and (mixed[:, 1:3] == 0).all()
    assert not Faults(0.03).is_random and EVERY.is_random


def test_fixed_faults_do_what_they_did():
    """The formulas without amounts per episode, on the same draws: bit for bit."""
    faults = Faults(range_noise=0.04, dropout=0.1, velocity_noise=0.03)
    amounts = faults.draw(6, torch.Generator())
    ranges = 4.3 * torch.rand(6, 50, dtype=F64)
    velocity, low, high = (
        torch.rand(6, 2, dtype=F64),
        torch.tensor([0.0, -3.0]),
        torch.tensor([0.5, 3.0]),
    )
    first, second = (torch.Generator().manual_seed(5) for _ in range(2))
    noise = torch.randn(ranges.shape, generator=first, dtype=F64)
    expected = ranges + torch.where(ranges < 4.0, 0.04 * noise, 0.0)
    lost = torch.rand(ranges.shape, generator=first, dtype=F64) < 0.1
    expected = expected.masked_fill(lost, 4.0)
    assert torch.equal(faults.disturb_ranges(ranges, amounts, 4.0, second), expected)
    low, high = low.double(), high.double()
    noise = torch.randn(velocity.shape, generator=first, dtype=F64)
    expected = velocity + 0.03 * (high - low) * noise
    assert torch.equal(faults.disturb_velocity(velocity, amounts, low, high, second), expected)


# --- in the environment


@pytest.mark.parametrize("snapshots", [True, False])
def test_specs(snapshots):
    env = make_env(num_envs=3, faults=EVERY, snapshots=snapshots, num_rays=30)
    check_env_specs(env)
    assert ("faults" in env.observation_spec.keys()) == snapshots
    assert "faults" not in make_env(faults=Faults(0.1)).observation_spec.keys()


def test_scenes_of_a_seed_are_those_without_faults():
    clean, faulty = make_env(num_envs=4), make_env(num_envs=4, faults=EVERY)
    for _ in range(3):
        starts = [env.reset() for env in (clean, faulty)]
        for key in ("pose", "human_pose", ("scene", "goal"), ("scene", "boxes")):
            assert torch.equal(starts[0][key], starts[1][key])


def test_a_seed_fixes_the_faults():
    env, twin = (make_env(num_envs=4, faults=EVERY, num_rays=30) for _ in range(2))
    first = env.reset()
    assert torch.equal(first["faults"], twin.reset()["faults"])
    again = env.reset()
    assert not torch.equal(first["faults"], again["faults"])
    env.set_seed(0)
    repeated = env.reset()
    assert torch.equal(first["faults"], repeated["faults"])
    assert torch.equal(first["scan"], repeated["scan"])


def test_each_scan_has_the_noise_and_the_dropout_of_its_episode():
    clean = make_env(num_envs=40).reset()["scan"]
    noisy = make_env(num_envs=40, faults=Faults(range_noise=(0.0, 0.1))).reset()
    hit = (clean < 3.2) & (clean > 0.8)  # eight standard deviations from the limits
    counts = hit.sum(1)
    wide = counts > 40
    assert wide.sum() > 20
    error = torch.where(hit, noisy["scan"] - clean, 0.0)
    deviation = (error.square().sum(1) / counts).sqrt()[wide]
    expected = noisy["faults"][wide, 0]
    assert ((deviation / expected - 1).abs() < 5 / (2 * counts[wide]).sqrt()).all()

    lossy = make_env(num_envs=40, faults=Faults(dropout=(0.0, 1.0))).reset()
    hit = clean < 4.0
    lost = ((lossy["scan"] == 4.0) & hit).sum(1) / hit.sum(1)
    rate = lossy["faults"][:, 1]
    tolerance = 5 * (rate * (1 - rate) / hit.sum(1)).sqrt() + 1e-9
    assert ((lost - rate).abs() <= tolerance)[wide].all()


def test_commands_are_late_in_those_episodes_that_drew_it():
    env = make_env(num_envs=12, num_rays=1, faults=Faults(latency=(0, 1)))
    data = env.reset()
    late = data["faults"][:, 3].bool()
    assert 0 < late.sum() < 12
    actions = torch.stack([env.action_spec.rand() for _ in range(5)])
    before = torch.zeros_like(actions[0])
    for action in actions:
        data = env.step(data.set("action", action))["next"]
        executed = torch.from_numpy(env.batch.ctrl[:, :2].copy())
        assert torch.equal(executed, torch.where(late[:, None], before, action))
        assert torch.equal(data["pending_action"], action)
        assert torch.equal(data["faults"][:, 3].bool(), late)
        before = action


def test_executed_velocities_have_the_noise_of_their_episode():
    env = make_env(num_envs=800, num_rays=1, faults=Faults(velocity_noise=(0.0, 0.06)))
    data = env.reset()
    share = data["faults"][:, 2:3]
    action = torch.tensor([0.25, 0.0], dtype=F64)
    env.step(data.set("action", action.expand(800, 2)))
    extent = torch.tensor([0.5, 2 * math.pi], dtype=F64)
    noise = (torch.from_numpy(env.batch.ctrl[:, :2].copy()) - action) / (share * extent)
    # Standard normal, whatever the amount.
    for half in (share[:, 0] < 0.03, share[:, 0] >= 0.03):
        assert (noise[half].mean(0).abs() < 5 / math.sqrt(half.sum())).all()
        assert ((noise[half].std(0) - 1).abs() < 5 / math.sqrt(2 * half.sum())).all()


def test_only_the_episodes_that_begin_draw():
    env = make_env(num_envs=6, num_rays=30, faults=EVERY)
    before = env.reset()
    mask = torch.tensor([True, False, True, False, False, True])[:, None]
    after = env.reset(before.clone().set("_reset", mask), set_state=False)
    changed = (after["faults"] != before["faults"]).any(-1)
    assert torch.equal(changed, mask[:, 0])


def test_a_snapshot_goes_on_with_its_faults():
    env = make_env(num_envs=3, num_rays=1, faults=Faults(latency=(0, 1)))
    data = env.reset()
    while data["faults"][:, 3].unique().numel() == 1:
        data = env.reset()
    actions = [env.action_spec.rand() for _ in range(4)]
    data = env.step(data.set("action", actions[0]))["next"]
    row = data.clone()
    runs = []
    for _ in range(2):
        env.reset()  # others, in between
        data = env.reset(row.clone(), set_state=True)
        assert torch.equal(data["faults"], row["faults"])
        for action in actions[1:]:
            data = env.step(data.set("action", action))["next"]
        runs.append(data["qpos"].clone())
    assert torch.equal(*runs)
    with pytest.raises(ValueError, match=r"The snapshot lacks \['faults'\]"):
        env.reset(row.exclude("faults"), set_state=True)


# --- from a configuration


def test_configurations_become_faults():
    assert get_faults(None) == get_faults({}) == Faults()
    assert get_faults(EVERY) is EVERY
    cfg = OmegaConf.create({"range_noise": [0.0, 0.05], "dropout": 0.1, "latency": [0, 1]})
    expected = Faults((0.0, 0.05), 0.1, latency=(0, 1))
    assert get_faults(cfg) == expected
    assert hash(get_faults(cfg)) == hash(expected)
    assert get_faults(config("pd_morl").env.faults) == Faults()
    env = make_policy_env(num_envs=2, num_threads=1, faults=cfg)
    assert env.base_env.faults == expected


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"fog": 0.1}, "Unknown fault 'fog': choose among"),
        ({"range_noise": [0.1, 0.0]}, "range_noise must be a number or a pair in ascending order"),
        ({"range_noise": [0.1]}, "range_noise must be a number or a pair"),
        ({"dropout": "much"}, "dropout must be a number or a pair"),
        ({"dropout": None}, "dropout must be a number or a pair"),
        ({"velocity_noise": [-0.1, 0.1]}, "velocity_noise must not be negative, got"),
        ({"dropout": [0.5, 1.5]}, r"probability in \[0, 1\], got \(0.5, 1.5\)"),
        ({"latency": [0, 4]}, r"latency must be 0 to 3 control steps, got \(0, 4\)"),
    ],
)
def test_configurations_are_checked(given, message):
    with pytest.raises(ValueError, match=message):
        get_faults(OmegaConf.create(given))


def test_what_was_demonstrated_knows_no_faults():
    overrides = ("evaluation.episodes=3", "env.max_episode_steps=40")
    card = {"demonstrator": {"radius": 1.0, "side": "left", "speed": 0.5, "robot": "turtlebot2"}}
    faults = ("env.faults.velocity_noise=[0.1,0.3]", "env.faults.latency=[0,1]")
    clean, faulty = (
        task.demonstrated(cfg, card, task.evaluation_start(cfg))
        for more in ((), faults)
        for cfg in [config("pd_morl", (*overrides, *more))]
    )
    assert (clean == faulty).all()
