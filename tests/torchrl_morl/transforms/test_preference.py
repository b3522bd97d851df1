from __future__ import annotations

import copy
from functools import partial

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from tests._transform_base import SPACE, TransformTests, make_env, parallel
from torchrl_morl.preferences import PreferenceSpace
from torchrl_morl.segments import PreferenceSegments
from torchrl_morl.transforms import LidarMinPool, PreferenceSampler

THREE = PreferenceSpace(("a", "b", "c"))


def sampled(batch_size=(4,), preference_space=SPACE, **kwargs) -> TransformedEnv:
    return TransformedEnv(
        make_env(batch_size=batch_size), PreferenceSampler(preference_space, **kwargs)
    )


class TestPreferenceSampler(TransformTests):
    def make_transform(self):
        return PreferenceSampler(SPACE)

    def test_transform_no_env(self):
        data = PreferenceSampler(SPACE, seed=0)(TensorDict(batch_size=[5, 2]))
        assert data["preference"].shape == (5, 2, 2)
        SPACE.validate(data["preference"])

    def test_transform_compose(self):
        env = TransformedEnv(make_env(), Compose(LidarMinPool(4), self.make_transform()))
        check_env_specs(env)
        SPACE.validate(env.reset()["preference"])

    @pytest.mark.parametrize("prefix", [None, "agent"])
    @pytest.mark.parametrize("batch_size", [(), (3,), (2, 2)])
    @pytest.mark.parametrize("num_segments", [None, 3])
    def test_transform_env(self, prefix, batch_size, num_segments):
        base = make_env(prefix=prefix, batch_size=batch_size, horizon=3)
        key = base.key("preference")
        sampler = PreferenceSampler(SPACE, preference_key=key, num_segments=num_segments)
        env = TransformedEnv(base, sampler)
        check_env_specs(env)
        data = env.rollout(20, break_when_any_done=False)
        SPACE.validate(data[key])
        assert torch.equal(data["next", key], data[key])
        following, before = data[key][..., 1:, :], data[key][..., :-1, :]
        done = data["next", "done"][..., :-1, :]
        assert done.any() and torch.equal((following != before).any(-1, keepdim=True), done)

    def test_specs(self):
        env = sampled()
        for spec in (env.observation_spec["preference"], env.state_spec["preference"]):
            assert spec.shape == (4, 2)
            assert (spec.space.low == 0).all() and (spec.space.high == 1).all()
        assert "preference" not in env.base_env.state_spec.keys()

    def test_transform_model(self):
        model = TensorDictSequential(PreferenceSampler.fixed(SPACE, [0.25, 0.75]))
        assert model(TensorDict(batch_size=[3]))["preference"].tolist() == [[0.25, 0.75]] * 3

    def test_transform_rb(self):
        """Data without a preference get one; data with one keep it."""
        data = TensorDict(reward=torch.zeros(10, 3), next=TensorDict(), batch_size=[10])
        for given in (False, True):
            if given:
                data["preference"] = torch.tensor([1.0, 0.0]).expand(10, 2)
                data["next", "preference"] = torch.tensor([0.0, 1.0]).expand(10, 2)
            buffer = TensorDictReplayBuffer(
                storage=LazyTensorStorage(10), batch_size=6, transform=self.make_transform()
            )
            buffer.extend(data)
            batch = buffer.sample()
            SPACE.validate(batch["preference"])
            assert (batch["preference"][:, 0] == 1).all() == given
            if given:
                assert (batch["next", "preference"][:, 1] == 1).all()
            else:
                assert torch.equal(batch["next", "preference"], batch["preference"])

    def test_transform_inverse(self):
        data = TensorDict(preference=torch.rand(3, 2), batch_size=[3])
        assert (self.make_transform().inv(data) == data).all()

    def test_collector(self):
        collector = Collector(sampled(seed=0), frames_per_batch=80, total_frames=160)
        try:
            for data in collector:
                SPACE.validate(data["preference"])
                assert torch.equal(data["next", "preference"], data["preference"])
                changed = data["preference"][:, 1:] != data["preference"][:, :-1]
                assert torch.equal(changed.any(-1), data["next", "done"][:, :-1, 0])
        finally:
            collector.shutdown()

    def test_partial_reset(self):
        env = sampled()
        mask = torch.tensor([[True], [False], [False], [True]])
        data = env.step(env.rand_action(env.reset()))["next"]
        before = data["preference"].clone()
        data["done"], data["truncated"] = mask, mask
        after = env.maybe_reset(data)
        assert torch.equal((after["preference"] != before).any(-1), mask[:, 0])


class TestUserPreferences:
    @pytest.mark.parametrize("batch_size", [(), (4,)])
    def test_given_at_reset(self, batch_size):
        env = sampled(batch_size)
        given = torch.tensor([0.25, 0.75]).expand(*batch_size, 2)
        reset = env.reset(TensorDict(preference=given, batch_size=batch_size))
        assert torch.equal(reset["preference"], given)
        data = env.rollout(4, auto_reset=False, tensordict=reset)
        assert (data["preference"] == given.unsqueeze(-2)).all()

    @pytest.mark.parametrize("inside", [True, False])
    @pytest.mark.parametrize("build", [partial(SerialEnv, 2), parallel], ids=["serial", "parallel"])
    def test_in_batched_envs(self, inside, build):
        if inside:
            env = build(lambda: sampled(()))
        else:
            env = TransformedEnv(build(make_env), PreferenceSampler(SPACE))
        try:
            given = torch.eye(2)
            reset = env.reset(TensorDict(preference=given, batch_size=[2]))
            assert torch.equal(reset["preference"], given)
            reset["preference"] = given.flip(0)
            carried = env.step_and_maybe_reset(env.rand_action(reset))[1]
            assert torch.equal(carried["preference"], given.flip(0))
            data = env.rollout(12, break_when_any_done=False)
            SPACE.validate(data["preference"])
            # Workers do not go through the same preferences in lockstep.
            assert (data["preference"][0] != data["preference"][1]).any(-1).all()
        finally:
            env.close()

    def test_changed_in_mid_episode(self):
        env = sampled(())
        carried = env.reset()
        for _ in range(2):
            carried = env.step_and_maybe_reset(env.rand_action(carried))[1]
        drawn = carried["preference"].clone()
        wish = torch.tensor([1.0, 0.0])
        carried["preference"] = wish
        while True:
            stored, carried = env.step_and_maybe_reset(env.rand_action(carried))
            assert torch.equal(stored["preference"], wish)
            assert torch.equal(stored["next", "preference"], wish)
            if stored["next", "done"]:
                break
            assert torch.equal(carried["preference"], wish)
        assert not torch.equal(carried["preference"], wish)
        assert not torch.equal(carried["preference"], drawn)

    def test_change_in_place_leaves_the_past_alone(self):
        env = sampled()
        first, carried = env.step_and_maybe_reset(env.rand_action(env.reset()))
        before = first.clone()
        carried["preference"].copy_(torch.tensor([1.0, 0.0]))
        assert torch.equal(first["preference"], before["preference"])

    def test_invalid_at_reset(self):
        env = sampled((2,))
        given = torch.tensor([[0.5, 0.5], [0.5, 0.75]])
        with pytest.raises(ValueError, match=r"preference\[1\].*sums to 1.25"):
            env.reset(TensorDict(preference=given, batch_size=[2]))
        with pytest.raises(ValueError, match=r"must have shape \[2, 2\] at reset, got \[2, 1, 2\]"):
            env.reset(TensorDict(preference=given.unsqueeze(1), batch_size=[2]))
        reset = env.reset(TensorDict(preference=torch.eye(2).double(), batch_size=[2]))
        assert reset["preference"].dtype == torch.get_default_dtype()


OFF_THE_SIMPLEX = [
    ((1e6, 0.0, 0.0), r"preference\[0\] = \[1000000.0, 0.0, 0.0\] .* sums to 1e\+06"),
    ((-1.0, 1.0, 1.0), r"preference\[0, 0\] = -1 for objective 'a' must be finite and >= 0"),
    ((1.0, 1.0, 0.0), r"preference\[0\] = .* sums to 2; it must sum to 1 within 0.0001"),
    ((float("nan"), 1.0, 0.0), r"preference\[0, 0\] = nan for objective 'a' must be finite"),
    ((0.0, 0.0, 0.0), r"sums to 0; it must sum to 1"),
]


class TestPreferencesOffTheSimplex:
    @pytest.mark.parametrize("in_place", [True, False])
    @pytest.mark.parametrize(("given", "message"), OFF_THE_SIMPLEX)
    def test_refused_by_a_step_before_anything_moves(self, given, message, in_place):
        env = sampled((2,), THREE)
        _, carried = env.step_and_maybe_reset(env.rand_action(env.reset()))
        count = env.base_env._count.clone()
        if in_place:
            carried["preference"][0] = torch.tensor(given)
        else:
            carried["preference"] = torch.tensor([given, (1.0, 0.0, 0.0)])
        with pytest.raises(ValueError, match=message):
            env.step(env.rand_action(carried))
        assert torch.equal(env.base_env._count, count)
        carried["preference"] = torch.eye(3)[:2]
        env.step(env.rand_action(carried))
        assert torch.equal(env.base_env._count, count + 1)

    @pytest.mark.parametrize("batch_size", [(), (4,), (2, 3)])
    def test_refused_in_the_first_step_and_behind_a_reset_of_some(self, batch_size):
        env = sampled(batch_size, THREE)
        wrong = torch.tensor([1.0, 1.0, 0.0]).expand(*batch_size, 3)
        for steps in (0, 5):  # five: episodes have ended in some
            carried = env.reset()
            for _ in range(steps):
                carried = env.step_and_maybe_reset(env.rand_action(carried))[1]
            carried["preference"] = wrong.clone()
            with pytest.raises(ValueError, match="sums to 2"):
                env.step(env.rand_action(carried))

    def test_refused_in_inference_mode_and_by_a_rollout(self):
        env = sampled((2,), THREE)
        with torch.inference_mode():
            carried = env.step_and_maybe_reset(env.rand_action(env.reset()))[1]
            env.step(env.rand_action(carried))
            carried["preference"][1, 0] = 2.0
            with pytest.raises(ValueError, match=r"preference\[1\]"):
                env.step(env.rand_action(carried))
        start = env.reset()
        start["preference"] = torch.full((2, 3), 1.0)
        with pytest.raises(ValueError, match="sums to 3"):
            env.rollout(3, auto_reset=False, tensordict=start)

    def test_refused_where_workers_hold_the_sampler(self):
        env = SerialEnv(2, lambda: sampled((), THREE))
        carried = env.reset()
        carried["preference"] = torch.tensor([[1.0, 0.0, 0.0], [1.0, 0.0, 1.0]])
        with pytest.raises(ValueError, match="sums to 2"):
            env.step(env.rand_action(carried))
        env.close()

    def test_refused_by_a_deep_copy_as_by_the_original(self):
        for env in (sampled((2,), THREE), copy.deepcopy(sampled((2,), THREE))):
            carried = env.reset()
            carried["preference"][0, 0] += 1
            with pytest.raises(ValueError, match="sums to 2"):
                env.step(env.rand_action(carried))

    def test_what_was_handed_out_is_not_looked_at_again(self, monkeypatch):
        """A step must not pay for what cannot have changed."""
        looked_at = []
        validate = PreferenceSpace.validate
        monkeypatch.setattr(
            PreferenceSpace,
            "validate",
            lambda self, *args, **kwargs: looked_at.append(1) or validate(self, *args, **kwargs),
        )
        env = TransformedEnv(
            make_env(batch_size=(4,), horizon=100), Compose(PreferenceSampler(THREE))
        )
        env.rollout(50, break_when_any_done=False)
        assert not looked_at

    def test_replay_buffers_keep_what_they_are_given(self):
        """Rows may be padding, and nothing is driven by them."""
        buffer = TensorDictReplayBuffer(
            storage=LazyTensorStorage(4), transform=Compose(PreferenceSampler(THREE)), batch_size=2
        )
        buffer.extend(TensorDict(preference=torch.zeros(4, 3), batch_size=[4]))
        assert (buffer.sample()["preference"] == 0).all()


class TestSegmentsAndFixed:
    def test_env_draws_from_its_segment(self):
        env = sampled((7,), preference_space=THREE, num_segments=3, seed=0)
        data = env.rollout(40, break_when_any_done=False)
        index = PreferenceSegments(THREE, 3).index(data["preference"])
        assert torch.equal(index, (torch.arange(7) % 3).unsqueeze(-1).expand(7, 40))
        assert data["preference"][0].unique(dim=0).shape[0] > 4

    def test_a_worker_with_too_few_envs_is_refused(self):
        with pytest.raises(ValueError, match=r"worker of 1 environment.*last of 3 segments"):
            SerialEnv(2, lambda: sampled((), num_segments=3)).reset()

    @pytest.mark.parametrize("batch_size", [(), (3,), (2, 2)])
    def test_one_fixed_preference(self, batch_size):
        sampler = PreferenceSampler.fixed(SPACE, [0.25, 0.75])
        env = TransformedEnv(make_env(batch_size=batch_size), sampler)
        check_env_specs(env)
        data = env.rollout(20, break_when_any_done=False)
        assert (data["preference"] == torch.tensor([0.25, 0.75])).all()

    @pytest.mark.parametrize("batch_size", [(6,), (2, 3)])
    def test_one_fixed_row_per_env(self, batch_size):
        rows = SPACE.lattice(5)
        env = TransformedEnv(make_env(batch_size=batch_size), PreferenceSampler.fixed(SPACE, rows))
        data = env.rollout(20, break_when_any_done=False)
        assert (data["preference"] == rows.reshape(*batch_size, 1, 2)).all()
        assert torch.equal(env.transform.state_dict()["preferences"], rows)

    def test_fixed_gives_way_to_the_user(self):
        env = TransformedEnv(make_env(), PreferenceSampler.fixed(SPACE, [0.25, 0.75]))
        assert env.reset(TensorDict(preference=torch.tensor([1.0, 0.0])))["preference"][0] == 1

    def test_invalid(self):
        with pytest.raises(ValueError, match="sums to 2"):
            PreferenceSampler.fixed(SPACE, [1.0, 1.0])
        env = TransformedEnv(
            make_env(batch_size=(4,)), PreferenceSampler.fixed(SPACE, torch.eye(2))
        )
        with pytest.raises(ValueError, match="2 fixed preferences do not fit a batch of 4"):
            env.reset()
        with pytest.raises(ValueError, match="'uniform'"):
            PreferenceSampler(SPACE, distribution="uniform")
        with pytest.raises(ValueError, match="num_segments"):
            PreferenceSampler(SPACE, num_segments=0)
        with pytest.raises(ValueError, match="slabs cut the segments of num_segments="):
            PreferenceSampler(SPACE, slabs=True)


class TestRandomness:
    @pytest.mark.parametrize("kwargs", [{}, {"num_segments": 4}, {"distribution": "abs_normal"}])
    def test_seed(self, kwargs):
        draws = []
        for seed in (1, 1, 2):
            torch.manual_seed(len(draws))  # the transform's own generator does not depend on it
            env = sampled(seed=seed, **kwargs)
            draws.append(env.rollout(20, break_when_any_done=False)["preference"])
        assert torch.equal(draws[0], draws[1])
        assert not torch.equal(draws[0], draws[2])

    def test_own_generator_leaves_the_global_one_alone(self):
        sampler = PreferenceSampler(SPACE, seed=0)
        state = torch.get_rng_state()
        sampler(TensorDict(batch_size=[3]))
        assert torch.equal(torch.get_rng_state(), state)

    def test_without_a_seed_the_global_generator_counts(self):
        draws = []
        for _ in range(2):
            torch.manual_seed(3)
            draws.append(PreferenceSampler(SPACE)(TensorDict(batch_size=[3]))["preference"])
        assert torch.equal(*draws)

    def test_distribution(self):
        for distribution, expected in (("dirichlet", 0.1), ("abs_normal", 0.07)):
            sampler = PreferenceSampler(SPACE, distribution=distribution, seed=0)
            value = sampler(TensorDict(batch_size=[40_000]))["preference"][:, 0]
            # |n_0| > 9 |n_1| has probability 2 / pi * atan(1 / 9) = 0.07.
            assert (value > 0.9).float().mean().item() == pytest.approx(expected, abs=6e-3)

    def test_state_dict(self):
        sampler = PreferenceSampler(SPACE, seed=0)
        sampler(TensorDict(batch_size=[3]))
        state = copy.deepcopy(sampler.state_dict())
        expected = sampler(TensorDict(batch_size=[3]))["preference"]
        for restored in (PreferenceSampler(SPACE, seed=5), PreferenceSampler(SPACE)):
            restored.load_state_dict(state)
            assert torch.equal(restored(TensorDict(batch_size=[3]))["preference"], expected)
        restored.load_state_dict(PreferenceSampler(SPACE).state_dict())
        assert restored.generator is None

    def test_clone_has_its_own_generator(self):
        sampler = PreferenceSampler(SPACE, seed=0)
        clone = sampler.clone()
        first = clone(TensorDict(batch_size=[3]))["preference"]
        assert torch.equal(sampler(TensorDict(batch_size=[3]))["preference"], first)


class TestNativeAutoReset:
    """Environments that reset themselves hand over the old preference together with the mask."""

    def test_only_reset_envs_change(self):
        env = sampled()
        data = env.reset()
        before = data["preference"].clone()
        data["_reset"] = torch.tensor([[True], [False], [True], [False]])
        after = env._reset_on_native_autoreset(data, data)["preference"]
        assert torch.equal((after != before).any(-1), data["_reset"][:, 0])

    def test_reset_key(self):
        env = sampled(reset_key="mine")
        data = env.reset()
        before = data["preference"].clone()
        data["mine"] = torch.tensor([[False], [True], [False], [False]])
        after = env._reset_on_native_autoreset(data, data)["preference"]
        assert torch.equal((after != before).any(-1), data["mine"][:, 0])
