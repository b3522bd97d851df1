from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from torchrl_morl.modules import RewardModel


def data(*batch: int) -> TensorDict:
    return TensorDict(
        observation=torch.randn(*batch, 4), action=torch.rand(*batch, 2), batch_size=batch
    )


@pytest.mark.parametrize("num_members", [1, 3])
@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
def test_starts_in_the_middle(num_members, batch):
    model = RewardModel(in_features=6, num_members=num_members)
    score = model(data(*batch))["demo_score"]
    assert score.shape == (*batch, 1)
    assert ((score - 0.5).abs() < 0.02).all()


def test_is_bounded():
    model = RewardModel(in_features=6, num_cells=(8,), last_layer_gain=1e4)
    score = model(data(100))["demo_score"]
    assert score.min() == 0 or score.min() < 1e-6
    assert score.max() > 1 - 1e-6
    assert ((score >= 0) & (score <= 1)).all()


def test_ensemble_is_the_mean_of_its_sigmoids():
    model = RewardModel(in_features=6, num_cells=(8,), num_members=3, last_layer_gain=1.0)
    batch = data(7)
    inputs = torch.cat([batch["observation"], batch["action"]], -1)
    scores = torch.stack([member(inputs).sigmoid() for member in model.module.members])
    assert torch.allclose(model(batch)["demo_score"], scores.mean(0))
    # Members are not copies of each other.
    assert (scores.std(0) > 0).all()


def test_rounds_hidden_layers_alone_under_autocast():
    batch = data(50)
    for num_cells, rounds in {(8,): False, (8, 8): True}.items():
        model = RewardModel(in_features=6, num_cells=num_cells, last_layer_gain=1.0)
        exact = model(batch.clone())["demo_score"]
        with torch.autocast("cpu", torch.bfloat16):
            score = model(batch.clone())["demo_score"]
        assert torch.equal(score, exact) is not rounds
        torch.testing.assert_close(score, exact, atol=0.02, rtol=0.02)


def test_state_dict_keys():
    model = RewardModel(in_features=6, num_cells=(8, 8), num_members=2)
    assert list(model.state_dict()) == [
        f"module.members.{member}.{layer}.{name}"
        for member in range(2)
        for layer in (0, 2, 4)
        for name in ("weight", "bias")
    ]
    other = RewardModel(in_features=6, num_cells=(8, 8), num_members=2)
    other.load_state_dict(model.state_dict())
    batch = data(3)
    assert torch.equal(other(batch.clone())["demo_score"], model(batch.clone())["demo_score"])


def test_keys_select_the_features():
    model = RewardModel(
        in_features=3, in_keys=[("agent", "goal")], num_cells=(8,), out_key=("agent", "style")
    )
    batch = TensorDict(agent=TensorDict(goal=torch.rand(5, 3)), human=torch.rand(5, 2))
    before = model(batch.clone())["agent", "style"]
    batch["human"] += 1
    assert torch.equal(model(batch)["agent", "style"], before)


def test_activation():
    model = RewardModel(in_features=6, num_cells=(8,), activation_class=nn.Tanh)
    assert isinstance(model.module.members[0][1], nn.Tanh)


def test_is_deterministic():
    models = []
    for _ in range(2):
        torch.manual_seed(3)
        models.append(RewardModel(in_features=6, num_cells=(8,), num_members=2))
    first, second = (model.state_dict() for model in models)
    assert all(torch.equal(first[key], second[key]) for key in first)


def test_invalid():
    with pytest.raises(ValueError, match="num_members must be at least 1, got 0"):
        RewardModel(in_features=6, num_members=0)
