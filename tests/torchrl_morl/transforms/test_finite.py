from __future__ import annotations

import re

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import check_env_specs

from envs.policy_env import make_policy_env
from tests._transform_base import SPACE, TransformTests, make_env
from torchrl_morl.transforms import CheckFinite, LidarMinPool, PreferenceSampler, check_finite

BAD = [float("nan"), float("inf"), -float("inf")]


def scans(value: float | None = None) -> TensorDict:
    """Two scans of three rays; a value replaces the last ray of the second."""
    scan = torch.arange(6.0).reshape(2, 3)
    if value is not None:
        scan[1, 2] = value
    return TensorDict(scan=scan, batch_size=[2])


class BrokenSensor:
    """Breaks one reading of an environment from a given call on; call 0 is the reset."""

    def __init__(self, env, key, position: tuple[int, ...], call: int) -> None:
        self.observe, self.key, self.position, self.calls = env._observe, key, position, -1
        self.call = call
        env._observe = self

    def __call__(self) -> TensorDict:
        self.calls += 1
        data = self.observe()
        if self.calls >= self.call:
            data[self.key][self.position] = torch.nan
        return data


class TestCheckFinite(TransformTests):
    def make_transform(self):
        return CheckFinite(["observation", "scan"])

    @pytest.mark.parametrize("value", BAD)
    def test_transform_no_env(self, value):
        check = CheckFinite(["scan"])
        data = scans()
        before = data.clone()
        assert check(data) is data
        assert (data == before).all()
        with pytest.raises(ValueError, match=rf"^'scan'\[1, 2\] = {value} must be finite \(1 of 6"):
            check(scans(value))

    def test_message_counts_and_names_the_first(self):
        data = scans(torch.nan)
        data["scan"][0, 1] = torch.inf
        with pytest.raises(ValueError, match=r"'scan'\[0, 1\] = inf .*\(2 of 6 values are not\)"):
            check_finite(data, ["scan"])
        with pytest.raises(ValueError, match=r"^'x' = nan must"):
            check_finite({"x": torch.tensor(torch.nan)}, ["x"])

    def test_integers_and_flags_are_finite(self):
        data = {"count": torch.arange(3), "flag": torch.ones(2, dtype=torch.bool)}
        check_finite(data, ["count", "flag"])

    def test_a_sum_that_overflows_is_no_reason(self):
        large = torch.full((4,), 3e38)
        check_finite(
            {"scan": large, "phase": torch.ones(2, dtype=torch.complex64)}, ["scan", "phase"]
        )
        large[2] = float("nan")
        with pytest.raises(ValueError, match=re.escape("'scan'[2] = nan")):
            check_finite({"scan": large}, ["scan"])

    def test_missing_key(self):
        with pytest.raises(KeyError, match="human"):
            CheckFinite(["human"])(scans())

    def test_transform_compose(self):
        check = Compose(CheckFinite(["scan"]), LidarMinPool(3))
        assert torch.equal(check(scans())["lidar"], scans()["scan"])
        broken = scans(torch.nan)
        with pytest.raises(ValueError, match="'scan'"):
            check(broken)
        assert "lidar" not in broken

    @pytest.mark.parametrize("prefix", [None, "agent"])
    @pytest.mark.parametrize("batch_size", [(), (3,), (2, 2)])
    def test_transform_env(self, prefix, batch_size):
        base = make_env(prefix=prefix, batch_size=batch_size)
        key = base.key("scan")
        env = TransformedEnv(base, CheckFinite([key]))
        check_env_specs(env)
        assert env.observation_spec == base.observation_spec
        position = (*(size - 1 for size in batch_size), 5)
        BrokenSensor(base, key, position, call=2)
        data = env.rand_step(env.reset())
        with pytest.raises(ValueError) as error:
            env.rand_step(data)
        assert str(error.value).startswith(f"{key!r}{list(position)} = nan")

    def test_reset_is_checked(self):
        base = make_env()
        BrokenSensor(base, "scan", (0,), call=0)
        with pytest.raises(ValueError, match=r"'scan'\[0\] = nan"):
            TransformedEnv(base, self.make_transform()).reset()

    @pytest.mark.parametrize("prefix", [None, "agent"])
    def test_rewards_are_checked_from_the_first_step_on(self, prefix):
        base = make_env(prefix=prefix, batch_size=(3,))
        keys = [base.key("observation"), base.key("reward")]
        env = TransformedEnv(base, CheckFinite(keys))
        check_env_specs(env)
        assert env.rollout(4, break_when_any_done=False).shape == (3, 4)
        step = base._step

        def broken(tensordict):
            data = step(tensordict)
            data[keys[1]][1, 2] = torch.nan
            return data

        base._step = broken
        data = env.rand_action(env.reset())
        with pytest.raises(ValueError, match=re.escape(f"{keys[1]!r}[1, 2] = nan must be finite")):
            env.step(data)

    def test_a_key_that_is_never_there_ends_at_the_first_step(self):
        env = TransformedEnv(make_env(), CheckFinite(["observation", "rewards"]))
        with pytest.raises(KeyError, match="rewards"):
            env.rand_step(env.reset())

    def test_transform_model(self):
        model = TensorDictSequential(CheckFinite(["scan"]), LidarMinPool(3))
        assert "lidar" in model(scans())
        with pytest.raises(ValueError, match="'scan'"):
            model(scans(torch.nan))

    def test_transform_rb(self):
        keys = ["scan", ("next", "scan")]
        buffer = TensorDictReplayBuffer(
            storage=LazyTensorStorage(2), batch_size=8, transform=CheckFinite(keys)
        )
        data = scans()
        data["next"] = scans()
        buffer.extend(data)
        assert buffer.sample().shape == (8,)
        data["next", "scan"][:] = torch.nan
        buffer.extend(data)
        with pytest.raises(ValueError, match=r"\('next', 'scan'\)\[0, 0\] = nan"):
            buffer.sample()

    def test_transform_inverse(self):
        # What goes into a buffer is not checked: only what is read.
        assert CheckFinite(["scan"]).inv(scans(torch.nan))["scan"].isnan().sum() == 1


@pytest.mark.parametrize("key", ["scan", "goal", "human"])
def test_navigation_names_the_sensor(key, monkeypatch):
    env = make_policy_env(PreferenceSampler(SPACE), num_envs=2, num_threads=1, seed=0)
    base = env.base_env
    observe = base._make_obs

    def broken(ids=None):
        data = observe(ids)
        data[key][1, 1] = torch.nan
        return data

    data = env.reset()
    monkeypatch.setattr(base, "_make_obs", broken)
    with pytest.raises(ValueError, match=rf"'{key}'\[1, 1\] = nan"):
        env.rand_step(data)
    env.close()
