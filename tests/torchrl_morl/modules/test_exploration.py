"""Held epsilon-greedy noise: how much of it, for how long, and when not at all."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torchrl.data import Bounded
from torchrl.envs.utils import ExplorationType, set_exploration_type

from envs import NavigationEnv
from envs.demonstrations import StraightDriver
from torchrl_morl.modules import HeldEGreedyModule

SPEC = Bounded(-1.0, 1.0, (2,))
POLICY = 5.0  # what the policy would do, outside of what the noise can be


def drive(noise: HeldEGreedyModule, steps: int, *batch: int) -> torch.Tensor:
    """Actions ``[*batch, steps, 2]`` of a policy that always does the same, plus noise."""
    data = TensorDict(batch_size=batch)
    actions = []
    with set_exploration_type(ExplorationType.RANDOM):
        for _ in range(steps):
            data = noise(data.set("action", torch.full((*batch, 2), POLICY)))
            actions.append(data["action"].clone())
    return torch.stack(actions, dim=-2)


def noisy(actions: torch.Tensor) -> torch.Tensor:
    """Which steps ``[..., T]`` do not follow the policy."""
    return (actions != POLICY).any(-1)


def stretches(actions: torch.Tensor) -> list[int]:
    """Lengths of the stretches of one random action in ``[T, 2]`` that end before the end."""
    lengths, previous = [], None
    for action in actions.tolist():
        if action == previous:
            lengths[-1] += 1
        elif action != [POLICY, POLICY]:
            lengths.append(1)
        previous = action if action != [POLICY, POLICY] else None
    return lengths if previous is None else lengths[:-1]


@pytest.mark.parametrize(("eps", "hold"), [(0.05, 5), (0.2, 5), (0.5, 5), (0.5, 20), (0.9, 3)])
def test_eps_is_the_share_of_noisy_steps_in_the_long_run(eps, hold):
    batch, steps, warm_up = 1000, 200, 60
    share = noisy(drive(HeldEGreedyModule(SPEC, eps, hold, seed=0), steps + warm_up, batch))
    share = share[:, warm_up:].float().mean().item()
    # Steps of a stretch are not independent: count each stretch as two samples' worth of error.
    error = math.sqrt(eps * (1 - eps) * 2 * hold / (batch * steps))
    assert abs(share - eps) < 4 * error
    assert 4 * error < 0.15 * eps


@pytest.mark.parametrize("hold", [1, 2, 7])
def test_a_random_action_lasts_exactly_hold_steps(hold):
    actions = drive(HeldEGreedyModule(SPEC, 0.4, hold, seed=0), 100, 50)
    lengths = [length for row in actions for length in stretches(row)]
    assert len(lengths) > 100
    assert set(lengths) == {hold}


def test_hold_one_is_white_noise():
    eps, batch, steps = 0.3, 500, 200
    share = noisy(drive(HeldEGreedyModule(SPEC, eps, hold=1, seed=0), steps, batch)).double()
    bound = 4 / math.sqrt(batch * steps)
    assert abs(share.mean() - eps) < bound
    # No step tells anything about the next one, not even at the start.
    first, second = share[:, :-1] - eps, share[:, 1:] - eps
    assert abs((first * second).mean() / (eps * (1 - eps))) < bound
    assert abs(share[:, 0].mean() - eps) < 4 * math.sqrt(eps * (1 - eps) / batch)


def test_random_actions_are_uniform_within_the_spec():
    spec = Bounded(torch.tensor([0.0, -3.0]), torch.tensor([0.5, 3.0]))
    actions = drive(HeldEGreedyModule(spec, 1.0, hold=1, seed=0), 20, 500).flatten(0, 1)
    scaled = (actions - spec.space.low) / (spec.space.high - spec.space.low)
    assert scaled.min() >= 0
    assert scaled.max() <= 1
    for quantile in (0.1, 0.5, 0.9):
        assert torch.allclose(scaled.quantile(quantile, 0), torch.tensor(quantile), atol=0.02)
    assert abs(torch.corrcoef(scaled.T)[0, 1]) < 0.05


@pytest.mark.parametrize("batch", [(4,), (2, 3)])
def test_the_spec_of_several_environments_is_that_of_one(batch):
    low, high = torch.tensor([0.0, -3.0]), torch.tensor([0.5, 3.0])
    several = Bounded(low.repeat(*batch, 1), high.repeat(*batch, 1))
    data = TensorDict(action=torch.zeros(*batch, 2), batch_size=batch)
    with set_exploration_type(ExplorationType.RANDOM):
        out, expected = (
            HeldEGreedyModule(spec, 1.0, seed=0)(data.clone())
            for spec in (several, Bounded(low, high))
        )
    assert torch.equal(out["action"], expected["action"])
    assert out["held_steps"].shape == (*batch, 1)
    assert out["action"].flatten(0, -2).unique(dim=0).shape[0] == math.prod(batch)


def test_environments_with_bounds_of_their_own_are_refused():
    high = torch.ones(4, 2)
    high[1] = 2.0
    with pytest.raises(ValueError, match=r"different bounds within its batch dimensions \(4,\)"):
        HeldEGreedyModule(Bounded(-torch.ones(4, 2), high), 1.0)


def test_eps_zero_is_the_policy_and_eps_one_is_noise_alone():
    assert not noisy(drive(HeldEGreedyModule(SPEC, 0.0, seed=0), 30, 100)).any()
    assert noisy(drive(HeldEGreedyModule(SPEC, 1.0, seed=0), 30, 100)).all()


@pytest.mark.parametrize(
    "kind", [ExplorationType.DETERMINISTIC, ExplorationType.MEAN, ExplorationType.MODE]
)
def test_nothing_changes_under_deterministic_exploration(kind):
    data = TensorDict(action=torch.full((4, 2), POLICY), batch_size=[4])
    with set_exploration_type(kind):
        out = HeldEGreedyModule(SPEC, 1.0, seed=0)(data.clone())
    assert set(out.keys()) == {"action"}
    assert torch.equal(out["action"], data["action"])


def test_without_a_context_it_explores_like_torchrls_own_module():
    data = TensorDict(action=torch.full((4, 2), POLICY), batch_size=[4])
    assert noisy(HeldEGreedyModule(SPEC, 1.0, seed=0)(data)["action"]).all()


def test_any_batch_shape():
    actions = drive(HeldEGreedyModule(SPEC, 0.5, seed=0), 10, 3, 4)
    assert actions.shape == (3, 4, 10, 2)
    flags = noisy(actions).flatten(0, 1)
    assert (flags != flags[0]).any()


def test_nested_action_key():
    noise = HeldEGreedyModule(SPEC, 1.0, action_key=("agent", "action"), seed=0)
    data = TensorDict({"agent": {"action": torch.full((4, 2), POLICY)}}, batch_size=[4])
    with set_exploration_type(ExplorationType.RANDOM):
        assert noisy(noise(data)["agent", "action"]).all()


def test_a_rollout_carries_the_hold_from_step_to_step():
    env = NavigationEnv(scene="empty", num_envs=8, seed=0, num_threads=1, snapshots=False)
    noise = HeldEGreedyModule(env.action_spec[0], 0.4, hold=4, seed=1)
    policy = StraightDriver()
    with set_exploration_type(ExplorationType.RANDOM):
        data = env.rollout(40, TensorDictSequential(policy, noise), break_when_any_done=False)
    clean = policy(data.select("goal").clone())["action"]
    flags = (data["action"] != clean).any(-1)
    assert 0 < flags.float().mean() < 1
    left = data["held_steps"].squeeze(-1)
    for row in range(8):
        starts = [
            step
            for step in range(37)
            if flags[row, step] and left[row, step] == 3 and (step == 0 or left[row, step - 1] == 0)
        ]
        assert starts
        for step in starts:
            held = data["action"][row, step : step + 4]
            assert (held == held[0]).all()
            assert left[row, step : step + 4].tolist() == [3, 2, 1, 0]
        # No noisy step outside of these stretches (those cut off by the end aside).
        covered = {step + offset for step in starts for offset in range(4)}
        rest = [step for step in range(37) if flags[row, step] and step not in covered]
        assert rest == []


def test_a_seed_decides_and_leaves_the_global_generator_alone():
    state = torch.get_rng_state()
    first = drive(HeldEGreedyModule(SPEC, 0.5, seed=3), 20, 10)
    assert torch.equal(torch.get_rng_state(), state)
    assert torch.equal(drive(HeldEGreedyModule(SPEC, 0.5, seed=3), 20, 10), first)
    assert not torch.equal(drive(HeldEGreedyModule(SPEC, 0.5, seed=4), 20, 10), first)


def test_without_a_seed_the_global_generator_decides():
    runs = []
    for seed in (0, 0, 1):
        torch.manual_seed(seed)
        runs.append(drive(HeldEGreedyModule(SPEC, 0.5), 20, 10))
    assert torch.equal(runs[0], runs[1])
    assert not torch.equal(runs[0], runs[2])


@pytest.mark.parametrize("eps", [-0.1, 1.1, math.nan])
def test_eps_must_be_a_share(eps):
    with pytest.raises(ValueError, match=r"eps is a share in \[0, 1\]"):
        HeldEGreedyModule(SPEC, eps)


@pytest.mark.parametrize("hold", [0, -3])
def test_hold_must_be_at_least_a_step(hold):
    with pytest.raises(ValueError, match="hold must be at least 1 step"):
        HeldEGreedyModule(SPEC, 0.1, hold)


def test_agents_hold_their_own_actions():
    noises = [
        HeldEGreedyModule(SPEC, 0.5, 3, action_key=(name, "action"), seed=seed)
        for seed, name in enumerate("ab")
    ]
    data = TensorDict(batch_size=[5])
    with set_exploration_type(ExplorationType.RANDOM):
        for _ in range(4):
            for name, noise in zip("ab", noises):
                data = noise(data.set((name, "action"), torch.full((5, 2), POLICY)))
    for name, noise in zip("ab", noises):
        assert set(noise.out_keys) == {(name, k) for k in ("action", "held_action", "held_steps")}
        moving = data[name, "held_steps"].squeeze(-1) > 0
        assert torch.equal(data[name, "action"][moving], data[name, "held_action"][moving])
    assert not torch.equal(data["a", "held_action"], data["b", "held_action"])


def test_any_batch_size_of_the_tensordict():
    # The batch is that of the action: a tensordict may know less of it.
    data = TensorDict(action=torch.full((3, 4, 2), POLICY), batch_size=[3])
    out = HeldEGreedyModule(SPEC, 1.0, seed=0)(data)
    assert out["held_steps"].shape == (3, 4, 1)
    assert len(out["action"].flatten(0, 1).unique(dim=0)) == 12


def test_the_generator_is_in_the_state_dict():
    first, second = (HeldEGreedyModule(SPEC, 0.5, seed=seed) for seed in (0, 1))
    drive(first, 5, 4)
    second.load_state_dict(first.state_dict())
    assert torch.equal(drive(first, 5, 4), drive(second, 5, 4))
    without = HeldEGreedyModule(SPEC, 0.5)
    second.load_state_dict(without.state_dict())
    assert second.generator is None
