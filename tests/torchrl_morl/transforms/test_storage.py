"""What is stored stays as it is, whatever a sample-time transform does to a batch."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict, lazy_stack
from torchrl.data import LazyStackStorage, LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.replay_buffers.samplers import SamplerWithoutReplacement
from torchrl.envs import Compose

from tests.torchrl_morl.test_component_contract import reward_model
from torchrl_morl.preferences import PreferenceSpace
from torchrl_morl.testing import random_transitions
from torchrl_morl.transforms import (
    CheckFinite,
    HullRange,
    InUnitsOf,
    PolarFeatures,
    PreferenceOverlay,
    PreferenceRelabel,
    PreferenceSampler,
    RewardModelReward,
    ScalarizeReward,
    VelocityInFrame,
)
from torchrl_morl.transforms.stored import apart_from_storage

SPACE = PreferenceSpace(("core", "distance", "efficiency"), static={"core": 1.0})
SIZE = 6
TRANSFORMS = {
    "CheckFinite": lambda: CheckFinite(["observation", ("next", "reward")]),
    "HullRange": lambda: HullRange("observation"),
    "InUnitsOf": lambda: InUnitsOf("goal"),
    "PolarFeatures": lambda: PolarFeatures(["goal"], ["goal"]),
    "PreferenceOverlay": lambda: PreferenceOverlay(SPACE),
    "PreferenceRelabel": lambda: PreferenceRelabel(SPACE, 1.0, seed=0),
    "PreferenceSampler": lambda: PreferenceSampler(SPACE, preference_key="wish", seed=0),
    "ScalarizeReward": lambda: ScalarizeReward(SPACE),
    "VelocityInFrame": lambda: VelocityInFrame("goal", "pose", "velocity", period=0.5),
    "RewardModelReward": lambda: RewardModelReward(reward_model(0)),
    "all": lambda: Compose(
        *[make() for name, make in TRANSFORMS.items() if name not in ("all", "PolarFeatures")]
    ),
}
of_transforms = pytest.mark.parametrize("make", TRANSFORMS.values(), ids=TRANSFORMS)


def data() -> TensorDict:
    data = random_transitions(SPACE, SIZE, observation_size=4)
    data["goal"], data["next", "goal"], data["next", "pose"] = (
        torch.rand(SIZE, 2),
        torch.rand(SIZE, 2),
        torch.rand(SIZE, 3),
    )
    data["robot"] = 0.1 + torch.rand(SIZE, 6)
    data["pixels"] = torch.zeros(SIZE, 120, 200, 3, dtype=torch.uint8)
    return data


@of_transforms
def test_a_storage_of_elements_is_left_alone(make):
    original = data()
    buffers = [
        TensorDictReplayBuffer(
            storage=storage(SIZE),
            sampler=SamplerWithoutReplacement(shuffle=False),
            batch_size=SIZE,
            transform=make(),
        )
        for storage in (LazyStackStorage, LazyTensorStorage)
    ]
    for buffer in buffers:
        buffer.extend(original)
    for _ in range(3):
        samples = [buffer.sample().contiguous() for buffer in buffers]
        assert set(samples[0].keys(True, True)) == set(samples[1].keys(True, True))
        for key in samples[0].keys(True, True):
            assert torch.equal(samples[0][key], samples[1][key])
    for index in range(SIZE):
        stored = buffers[0].storage.get(index)
        # TorchRL notes the index.
        assert set(stored.keys(True, True)) - {"index"} == set(original.keys(True, True))
        assert (stored.exclude("index") == original[index]).all()


@of_transforms
def test_one_transition_may_be_there_several_times(make):
    element = data()[0]
    batch = make()(lazy_stack([element, element]))
    assert batch.shape == (2,)
    assert set(element.keys(True, True)) == set(data().keys(True, True))


def test_only_lazy_stacks_are_copied():
    dense = data()
    assert apart_from_storage(dense) is dense
    lazy = lazy_stack(list(dense.unbind(0)))
    copied = apart_from_storage(lazy)
    copied["next", "reward"] = torch.zeros(SIZE, 3)
    assert torch.equal(lazy["next", "reward"], dense["next", "reward"])
    assert copied.tensordicts[0]["observation"] is lazy.tensordicts[0]["observation"]
