"""An environment goes on from its state as if nothing had happened."""

from __future__ import annotations

import json

import pytest
import torch
from tensordict import TensorDict

from envs import Faults, NavigationEnv
from recipes.training.checkpoint import SafeStateAdapter

KINDS = {
    "static": {},
    "faults": {
        "faults": Faults(range_noise=(0.0, 0.05), dropout=0.1, velocity_noise=0.1, latency=(0, 1))
    },
    "failed again": {"scene": "exploring", "repeat_failed": 0.5, "max_episode_steps": 8},
    "walking, on wheels": {"scene": "moving_human", "drive": "wheels"},
}


class _Holder:
    def __init__(self, state=None) -> None:
        self.state = state

    def state_dict(self):
        return self.state

    def load_state_dict(self, state) -> None:
        self.state = state


def _through_files(state, folder):
    adapter = SafeStateAdapter()
    holder = _Holder()
    adapter.save(_Holder(state), folder, args=(), kwargs={})
    options = {"map_location": None, "tensor_load_kwargs": {}, "args": (), "kwargs": {}}
    adapter.load(holder, folder, **options)
    return holder.state


def _drive(env: NavigationEnv, current: TensorDict, actions: torch.Tensor) -> list[TensorDict]:
    seen = []
    for action in actions:
        stepped, current = env.step_and_maybe_reset(current.set("action", action.clone()))
        seen.append(stepped.clone())
    return seen


@pytest.mark.parametrize("snapshots", [True, False])
@pytest.mark.parametrize("kind", KINDS)
def test_goes_on_bit_by_bit(kind, snapshots, tmp_path):
    def make(seed: int) -> NavigationEnv:
        arguments = {"max_episode_steps": 12, **KINDS[kind]}
        return NavigationEnv(
            num_envs=5, seed=seed, num_threads=1, snapshots=snapshots, num_rays=60, **arguments
        )

    env, other = make(0), make(1)
    generator = torch.Generator().manual_seed(0)
    low, high = env.action_spec.space.low, env.action_spec.space.high
    actions = low + (high - low) * torch.rand(40, *low.shape, generator=generator)
    current = env.reset()
    other.reset()
    for action in actions[:17]:
        _, current = env.step_and_maybe_reset(current.set("action", action.clone()))
    kept = current.clone()
    other.load_simulation_state(_through_files(env.simulation_state(), tmp_path / "state"))
    expected = _drive(env, current, actions[17:])
    found = _drive(other, kept, actions[17:])
    for one, two in zip(expected, found, strict=True):
        assert (one == two).all()


def test_the_state_of_another_environment_is_refused():
    small, large = (NavigationEnv(num_envs=n, seed=0, num_threads=1) for n in (2, 3))
    with pytest.raises(ValueError, match=r"of 2 simulations .* here they are 3"):
        large.load_simulation_state(small.simulation_state())


@pytest.mark.parametrize(
    "value",
    [
        {"a": [1, 2.5, None, True, "text", float("nan")], ("b", 1): (1, (2, [3]))},
        {1: torch.arange(3), "t": torch.tensor(1.5, dtype=torch.float64), "e": torch.empty(0, 2)},
        {"nested": {"numpy": torch.rand(2).numpy(), "bits": 2**127 - 1}},
    ],
)
def test_states_come_back_as_they_were(value, tmp_path):
    found = _through_files(value, tmp_path / "state")
    assert repr(found) == repr(value)


def test_what_no_file_may_hold_is_refused(tmp_path):
    with pytest.raises(TypeError, match="cannot hold a function"):
        _through_files({"call": print if False else (lambda: None)}, tmp_path / "state")


def test_a_broken_state_is_refused(tmp_path):
    folder = tmp_path / "state"
    _through_files({"a": torch.ones(3)}, folder)
    (folder / "state.json").write_text(json.dumps({"dict": [["a", {"tensor": "000009"}]]}))
    options = {"map_location": None, "tensor_load_kwargs": {}, "args": (), "kwargs": {}}
    with pytest.raises(ValueError, match="holds no state"):
        SafeStateAdapter().load(_Holder(), folder, **options)


@pytest.mark.parametrize("now", [{"latency": (0, 1)}, {"latency": 3, "lag": 0.1}, None])
def test_episodes_go_on_with_the_faults_of_the_environment_that_they_go_on_in(now):
    def make(faults):
        return NavigationEnv(num_envs=4, num_rays=30, seed=0, num_threads=1, faults=faults)

    env, other = make({"latency": (0, 3)}), make(now)
    env.rollout(3)
    other.load_simulation_state(env.simulation_state())
    assert (other.simulation_state()["rows"] == env.simulation_state()["rows"]).all()
    assert other.rollout(6).shape[-1] == 6
