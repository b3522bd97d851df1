from __future__ import annotations

import copy

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torchrl.collectors import Collector
from torchrl.data import (
    LazyStackStorage,
    LazyTensorStorage,
    ListStorage,
    TensorDictReplayBuffer,
)
from torchrl.envs import Compose, TransformedEnv

from tests._transform_base import SPACE, TransformTests, make_env
from torchrl_morl.transforms import (
    PreferenceExpand,
    PreferenceRelabel,
    PreferenceSampler,
    ScalarizeReward,
)

CORNER = torch.tensor([1.0, 0.0])


def transitions(*batch: int, key="preference") -> TensorDict:
    """Every preference is a corner, which no draw ever is; rewards number the transitions."""
    number = torch.arange(torch.Size(batch).numel()).reshape(*batch, 1).float()
    data = TensorDict(next=TensorDict(reward=number, batch_size=batch), batch_size=batch)
    data[key] = CORNER.expand(*batch, 2).clone()
    data["next", key] = data[key].clone()
    return data


def relabelled(data: TensorDict, key="preference") -> torch.Tensor:
    return (data[key] != CORNER).any(-1)


def make_buffer(transform, size: int = 1000, batch_size: int = 1000) -> TensorDictReplayBuffer:
    return TensorDictReplayBuffer(
        storage=LazyTensorStorage(size), batch_size=batch_size, transform=transform
    )


class TestPreferenceRelabel(TransformTests):
    refusal = "PreferenceRelabel is for replay buffers"

    def make_transform(self):
        return PreferenceRelabel(SPACE)

    @pytest.mark.parametrize("key", ["preference", ("agent", "preference")])
    @pytest.mark.parametrize("batch", [(2000,), (500, 4)])
    def test_transform_no_env(self, key, batch):
        data = PreferenceRelabel(SPACE, 0.75, preference_key=key, seed=0)(
            transitions(*batch, key=key)
        )
        SPACE.validate(data[key])
        assert torch.equal(data["next", key], data[key])
        assert (
            data[key][relabelled(data, key)].unique(dim=0).shape[0] == relabelled(data, key).sum()
        )
        # Four standard deviations of the share.
        share = relabelled(data, key).float().mean().item()
        assert share == pytest.approx(0.75, abs=4 * (0.75 * 0.25 / 2000) ** 0.5)
        assert torch.equal(data["next", "reward"], transitions(*batch)["next", "reward"])

    def test_ratio_bounds(self):
        assert not relabelled(PreferenceRelabel(SPACE, 0.0)(transitions(100))).any()
        assert relabelled(PreferenceRelabel(SPACE, 1.0)(transitions(100))).all()

    def test_without_a_next_preference(self):
        data = transitions(100)
        del data["next", "preference"]
        data = PreferenceRelabel(SPACE, 1.0)(data)
        assert relabelled(data).all()
        assert ("next", "preference") not in data.keys(True)

    def test_what_is_not_relabelled_keeps_a_change_by_the_user(self):
        data = transitions(200)
        data["next", "preference"] = CORNER.flip(0).expand(200, 2).clone()
        data = PreferenceRelabel(SPACE, 0.5, seed=0)(data)
        new = relabelled(data)
        assert 0 < new.sum() < 200
        assert torch.equal(data["next", "preference"][new], data["preference"][new])
        assert (data["next", "preference"][~new] == CORNER.flip(0)).all()

    def test_transform_compose(self):
        both = Compose(self.make_transform(), PreferenceRelabel(SPACE, 1.0))
        assert relabelled(both(transitions(50))).all()

    def test_transform_env(self):
        for transform in (self.make_transform(), Compose(self.make_transform())):
            with pytest.raises(RuntimeError, match=self.refusal):
                TransformedEnv(make_env(), transform).rollout(2)

    def test_transform_model(self):
        relabel = PreferenceRelabel(SPACE, 1.0)
        assert relabelled(TensorDictSequential(relabel)(transitions(20))).all()
        data = torch.compile(relabel, fullgraph=True, backend="eager")(transitions(20))
        assert relabelled(data).all()
        assert torch.equal(data["next", "preference"], data["preference"])

    @pytest.mark.parametrize("ndim", [1, 2])
    def test_transform_rb(self, ndim):
        buffer = TensorDictReplayBuffer(
            storage=LazyTensorStorage(1000, ndim=ndim),
            batch_size=1000,
            transform=PreferenceRelabel(SPACE, 0.75, seed=0),
        )
        buffer.extend(transitions(*((1000,) if ndim == 1 else (250, 4))))
        first, second = buffer.sample(), buffer.sample()
        assert 0.68 < relabelled(first).float().mean() < 0.82
        assert torch.equal(first["next", "preference"], first["preference"])
        assert not torch.equal(first["preference"], second["preference"])
        stored = buffer.storage.get(slice(None))
        assert (stored["preference"] == CORNER).all()
        assert (stored["next", "preference"] == CORNER).all()

    @pytest.mark.parametrize("storage", [ListStorage, LazyStackStorage])
    def test_storage_of_elements(self, storage):
        buffer = TensorDictReplayBuffer(
            storage=storage(10), batch_size=200, transform=PreferenceRelabel(SPACE, 1.0, seed=0)
        )
        buffer.extend(transitions(10))
        batch = buffer.sample()
        assert len(batch["preference"].unique(dim=0)) == 200
        assert torch.equal(batch["next", "preference"], batch["preference"])
        for index in range(10):
            assert (buffer.storage.get(index)["preference"] == CORNER).all()

    def test_transform_inverse(self):
        data = transitions(10)
        assert (self.make_transform().inv(data) == data).all()

    @pytest.mark.parametrize("distribution", ["dirichlet", "abs_normal"])
    def test_distribution(self, distribution):
        value = PreferenceRelabel(SPACE, 1.0, distribution=distribution, seed=0)(
            transitions(40_000)
        )["preference"]
        expected = {"dirichlet": 0.1, "abs_normal": 0.07}[distribution]
        assert (value[:, 0] > 0.9).float().mean().item() == pytest.approx(expected, abs=6e-3)

    def test_seed_and_state_dict(self):
        def draw(transform):
            return transform(transitions(20))["preference"]

        first, again, other = (PreferenceRelabel(SPACE, seed=seed) for seed in (1, 1, 2))
        value = draw(first)
        assert torch.equal(value, draw(again)) and not torch.equal(value, draw(other))
        state = copy.deepcopy(first.state_dict())
        value = draw(first)
        other.load_state_dict(state)
        assert torch.equal(value, draw(other))

    def test_generator_is_in_the_state_of_the_buffer(self):
        buffer = make_buffer(PreferenceRelabel(SPACE, 1.0, seed=0))
        keys = buffer.state_dict()["_transforms"].keys()
        assert any(key.endswith("_extra_state") for key in keys)

    def test_dtype_is_kept(self):
        data = transitions(10).double()
        assert PreferenceRelabel(SPACE)(data)["preference"].dtype == torch.double

    def test_invalid(self):
        for ratio in (-0.1, 1.1, float("nan")):
            with pytest.raises(ValueError, match=f"got {ratio}"):
                PreferenceRelabel(SPACE, ratio)
        with pytest.raises(ValueError, match="'uniform'"):
            PreferenceRelabel(SPACE, distribution="uniform")


class TestPreferenceExpand(TransformTests):
    refusal = "PreferenceExpand is for replay buffers"

    def make_transform(self):
        return PreferenceExpand(SPACE)

    def test_transform_no_env(self):
        data = transitions(5)
        assert (self.make_transform()(data.clone()) == data).all()

    def test_transform_compose(self):
        expanded = Compose(PreferenceExpand(SPACE, 1), PreferenceExpand(SPACE, 2)).inv(
            transitions(4)
        )
        assert expanded.batch_size == (24,)
        # One of six is an original of both.
        assert (~relabelled(expanded)).sum() == 4

    def test_transform_env(self):
        for transform in (self.make_transform(), Compose(self.make_transform())):
            with pytest.raises(RuntimeError, match=self.refusal):
                TransformedEnv(make_env(), transform).rollout(2)

    def test_transform_model(self):
        data = transitions(5)
        assert (TensorDictSequential(self.make_transform())(data.clone()) == data).all()

    @pytest.mark.parametrize("key", ["preference", ("agent", "preference")])
    def test_transform_rb(self, key):
        buffer = make_buffer(PreferenceExpand(SPACE, 3, preference_key=key, seed=0))
        data = transitions(10, key=key)
        buffer.extend(data)
        assert len(buffer) == 40
        stored = buffer[:].reshape(10, 4)
        assert (relabelled(stored, key) == torch.tensor([False, True, True, True])).all()
        assert (stored["next", "reward"] == data["next", "reward"].unsqueeze(1)).all()
        assert torch.equal(stored["next", key], stored[key])
        assert len(stored[key].flatten(0, 1).unique(dim=0)) == 31
        SPACE.validate(stored[key])
        assert (data[key] == CORNER).all()

    def test_lazy_stack(self):
        data = TensorDict.lazy_stack(list(transitions(5)))
        expanded = PreferenceExpand(SPACE, 2).inv(data)
        assert len(expanded["preference"].unique(dim=0)) == 11
        assert (data["preference"] == CORNER).all()

    @pytest.mark.parametrize("batch", [(1,), (3, 2)])
    def test_transform_inverse(self, batch):
        data = transitions(*batch)
        expanded = PreferenceExpand(SPACE, 2).inv(data)
        assert expanded.batch_size == (3 * batch[0], *batch[1:])
        assert (expanded[::3] == data).all()
        assert relabelled(expanded[1::3]).all() and relabelled(expanded[2::3]).all()

    def test_through_a_collector(self):
        buffer = make_buffer(PreferenceExpand(SPACE, 3))
        env = TransformedEnv(make_env(), Compose(PreferenceSampler(SPACE), ScalarizeReward(SPACE)))
        collector = Collector(env, frames_per_batch=20, total_frames=20, replay_buffer=buffer)
        try:
            for _ in collector:
                pass
        finally:
            collector.shutdown()
        # Four episodes of five steps, and three copies of each of the 20 transitions.
        assert len(buffer) == 80
        assert len(buffer[:]["preference"].unique(dim=0)) == 4 + 60
        assert len(buffer[::4]["preference"].unique(dim=0)) == 4

    def test_seed(self):
        first, again, other = (
            PreferenceExpand(SPACE, seed=seed).inv(transitions(5))["preference"]
            for seed in (1, 1, 2)
        )
        assert torch.equal(first, again) and not torch.equal(first, other)

    def test_invalid(self):
        with pytest.raises(ValueError, match="got 0"):
            PreferenceExpand(SPACE, 0)
        with pytest.raises(ValueError, match=r"use rb\.extend"):
            make_buffer(self.make_transform()).add(transitions())
