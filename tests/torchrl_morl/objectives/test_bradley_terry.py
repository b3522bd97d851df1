"""Bradley-Terry loss: hand-computed numbers, what it learns and the loss-module contract."""

from __future__ import annotations

import math

import pytest
import scipy.stats
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn

from torchrl_morl.modules import RewardModel
from torchrl_morl.objectives import BradleyTerryLoss


def identity(out_key="demo_score", in_key="observation") -> TensorDictModule:
    """The observation is the reward."""
    return TensorDictModule(nn.Identity(), in_keys=[in_key], out_keys=[out_key])


def pairs(preferred, other) -> TensorDict:
    preferred, other = (torch.as_tensor(x).unsqueeze(-1) for x in (preferred, other))
    return TensorDict(
        preferred=TensorDict(observation=preferred, batch_size=preferred.shape[:-1]),
        other=TensorDict(observation=other, batch_size=other.shape[:-1]),
        batch_size=preferred.shape[:-2],
    )


def random_pairs(*batch: int, length: int = 5) -> TensorDict:
    def snippets():
        observation, action = torch.randn(*batch, length, 4), torch.randn(*batch, length, 2)
        return TensorDict(observation=observation, action=action, batch_size=(*batch, length))

    return TensorDict(preferred=snippets(), other=snippets(), batch_size=batch)


def model(**kwargs) -> RewardModel:
    return RewardModel(in_features=6, num_cells=(16,), **kwargs)


class TestNumbers:
    # Sums 1.4 and 0.6, 0.3 and 0.5.
    DATA = pairs([[0.9, 0.5], [0.1, 0.2]], [[0.2, 0.4], [0.4, 0.1]])

    @pytest.mark.parametrize(("beta", "scale"), [(1.0, 1.0), (4.0, 4.0), (None, 2.5)])
    def test_loss(self, beta, scale):
        losses = BradleyTerryLoss(identity(), beta=beta, reduction="none")(self.DATA)
        # -log sigmoid(x) = log(1 + exp(-x))
        expected = [math.log1p(math.exp(-scale * gap)) for gap in (0.8, -0.2)]
        assert losses["loss_bradley_terry"].tolist() == pytest.approx(expected, rel=1e-5)
        assert losses["accuracy"] == 0.5
        assert losses["margin"].item() == pytest.approx((0.8 - 0.2) / 2 / 2)

    def test_label_smoothing(self):
        losses = BradleyTerryLoss(identity(), beta=1.0, label_smoothing=0.2, reduction="none")(
            self.DATA
        )
        expected = [
            0.9 * math.log1p(math.exp(-gap)) + 0.1 * math.log1p(math.exp(gap))
            for gap in (0.8, -0.2)
        ]
        assert losses["loss_bradley_terry"].tolist() == pytest.approx(expected, rel=1e-5)

    def test_label_smoothing_is_that_of_cross_entropy(self):
        data = random_pairs(6)
        network = model(last_layer_gain=1.0)
        loss = BradleyTerryLoss(network, beta=2.0, label_smoothing=0.1)(data)
        total = torch.stack(
            [network(data[side])["demo_score"].sum((-1, -2)) for side in ("preferred", "other")], -1
        )
        expected = nn.functional.cross_entropy(
            2.0 * total, torch.zeros(6, dtype=torch.long), label_smoothing=0.1
        )
        assert torch.allclose(loss["loss_bradley_terry"], expected)

    def test_chance(self):
        losses = BradleyTerryLoss(identity())(pairs(torch.ones(3, 4), torch.ones(3, 4)))
        assert losses["loss_bradley_terry"].item() == pytest.approx(math.log(2))
        assert losses["accuracy"] == 0.5
        assert losses["margin"] == 0

    def test_reduction(self):
        loss = {
            reduction: BradleyTerryLoss(identity(), reduction=reduction)(self.DATA)[
                "loss_bradley_terry"
            ]
            for reduction in ("none", "sum", "mean")
        }
        assert loss["none"].shape == (2,)
        assert torch.allclose(loss["sum"], loss["none"].sum())
        assert torch.allclose(loss["mean"], loss["none"].mean())

    @pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
    def test_batch_shapes(self, batch):
        losses = BradleyTerryLoss(model(), reduction="none")(random_pairs(*batch))
        assert losses["loss_bradley_terry"].shape == batch
        assert losses["accuracy"].shape == losses["margin"].shape == ()


class TestLearning:
    def test_gradient_direction(self):
        data = pairs([[0.5, 0.5]], [[0.5, 0.5]])
        for side in ("preferred", "other"):
            data[side, "observation"].requires_grad_()
        BradleyTerryLoss(identity())(data)["loss_bradley_terry"].backward()
        assert (data["preferred", "observation"].grad < 0).all()
        assert (data["other", "observation"].grad > 0).all()

    def test_metadata_is_detached(self):
        losses = BradleyTerryLoss(model())(random_pairs(4))
        assert losses["loss_bradley_terry"].requires_grad
        assert not losses["accuracy"].requires_grad
        assert not losses["margin"].requires_grad

    def _train(self) -> tuple[TensorDict, torch.Tensor]:
        """Pairs that are ranked by the sum of a known linear reward."""
        torch.manual_seed(1)
        loss = BradleyTerryLoss(RewardModel(in_features=6, num_cells=(32, 32), num_members=2))
        optimizer = torch.optim.Adam(loss.parameters(), lr=3e-3)
        for _ in range(300):
            data = random_pairs(64, length=10)
            # The true order of each pair, whatever was drawn.
            total = {side: true_reward(data[side]).sum(-1) for side in ("preferred", "other")}
            swap = total["preferred"] < total["other"]
            first = torch.where(swap[:, None], data["other"], data["preferred"])
            second = torch.where(swap[:, None], data["preferred"], data["other"])
            data = TensorDict(preferred=first, other=second, batch_size=[64])
            loss(data)["loss_bradley_terry"].backward()
            optimizer.step()
            optimizer.zero_grad()
        with loss.reward_network_params.to_module(loss.reward_network):
            unseen = random_pairs(500)["preferred"][:, 0]
            return unseen, loss.reward_network(unseen.clone())["demo_score"].squeeze(-1).detach()

    def test_recovers_a_linear_reward_from_a_seed(self):
        unseen, score = self._train()
        rho = scipy.stats.spearmanr(score.numpy(), true_reward(unseen).numpy()).statistic
        assert rho > 0.95
        assert ((score >= 0) & (score <= 1)).all()
        assert torch.equal(self._train()[1], score)


def true_reward(data: TensorDict) -> torch.Tensor:
    weights = torch.tensor([1.0, -2.0, 0.5, 0.0])
    return data["observation"] @ weights + data["action"] @ torch.tensor([0.5, -1.0])


class TestContract:
    def test_unequal_lengths(self):
        data = TensorDict(
            preferred=random_pairs(3, length=5)["preferred"],
            other=random_pairs(3, length=4)["other"],
            batch_size=[3],
        )
        with pytest.raises(ValueError, match=r"equally long.*\[3, 5\].*\[3, 4\]"):
            BradleyTerryLoss(model())(data)

    def test_no_steps(self):
        data = TensorDict(preferred=TensorDict(a=torch.rand(1)), other=TensorDict(a=torch.rand(1)))
        with pytest.raises(ValueError, match="no steps"):
            BradleyTerryLoss(identity(in_key="a"))(data)

    @pytest.mark.parametrize("beta", [0.0, -1.0, math.nan])
    def test_invalid_beta(self, beta):
        with pytest.raises(ValueError, match="beta must be positive"):
            BradleyTerryLoss(model(), beta=beta)

    @pytest.mark.parametrize("smoothing", [-0.1, 1.0, math.nan])
    def test_invalid_label_smoothing(self, smoothing):
        with pytest.raises(ValueError, match="label_smoothing must be in"):
            BradleyTerryLoss(model(), label_smoothing=smoothing)

    def test_set_keys(self):
        loss = BradleyTerryLoss(identity(out_key=("agent", "style")), beta=1.0)
        loss.set_keys(preferred=("pair", "good"), other="bad", score=("agent", "style"))
        assert loss.in_keys == [("pair", "good", "observation"), ("bad", "observation")]
        data = TestNumbers.DATA
        renamed = TensorDict(pair=TensorDict(good=data["preferred"]), bad=data["other"])
        expected = BradleyTerryLoss(identity(), beta=1.0)(data)
        assert (loss(renamed) == expected).all()
        loss.set_keys(preferred=None)
        assert loss.tensor_keys.preferred == "preferred"
        with pytest.raises(ValueError, match="reward is not an accepted"):
            loss.set_keys(reward="r")

    def test_leaves_the_input_alone(self):
        data = random_pairs(4)
        keys = set(data.keys(True, True))
        BradleyTerryLoss(model())(data)
        assert set(data.keys(True, True)) == keys

    @pytest.mark.parametrize("reduction", ["mean", "none"])
    def test_dispatch(self, reduction):
        data = random_pairs(4)
        loss = BradleyTerryLoss(model(), reduction=reduction)
        kwargs = {"_".join(key): data[key] for key in loss.in_keys}
        assert list(kwargs) == [
            "preferred_observation",
            "preferred_action",
            "other_observation",
            "other_action",
        ]
        expected = loss(data)
        for key, value in zip(loss.out_keys, loss(**kwargs), strict=True):
            assert torch.equal(value, expected[key]), key

    def test_state_dict(self):
        loss, other = BradleyTerryLoss(model()), BradleyTerryLoss(model())
        assert not any("target" in key for key in loss.state_dict())
        data = random_pairs(4)
        other.load_state_dict(loss.state_dict())
        assert (other(data) == loss(data)).all()

    def test_trains_the_model_it_was_given(self):
        network = model()
        loss = BradleyTerryLoss(network)
        loss(random_pairs(4))["loss_bradley_terry"].backward()
        assert len(list(loss.parameters())) == 4
        for (name, own), given in zip(loss.named_parameters(), network.parameters(), strict=True):
            assert own.data_ptr() == given.data_ptr(), name
            assert own.grad is not None, name

    def test_reset_parameters_recursive(self):
        loss = BradleyTerryLoss(model(num_members=2))
        for parameter in loss.parameters():
            parameter.data.fill_(7.0)
        loss.reset_parameters_recursive()
        assert all((parameter != 7.0).all() for parameter in loss.parameters())
        # The last layers start small again.
        data = random_pairs(4)
        assert BradleyTerryLoss(model(), beta=1.0)(data)["margin"].abs() < 0.01
        assert loss(data)["margin"].abs() < 0.01

    @pytest.mark.parametrize("beta", [None, 0.3])
    def test_compile(self, beta):
        loss = BradleyTerryLoss(model(num_members=2), beta=beta, label_smoothing=0.1)
        data = random_pairs(4)
        compiled = torch.compile(loss, fullgraph=True, backend="eager")(data)
        eager = loss(data)
        assert all(torch.allclose(compiled[key], eager[key]) for key in loss.out_keys)
        compiled["loss_bradley_terry"].backward()
        assert all(parameter.grad is not None for parameter in loss.parameters())

    def test_double(self):
        loss = BradleyTerryLoss(model().double())
        data = random_pairs(4).apply(torch.Tensor.double)
        assert loss(data)["loss_bradley_terry"].dtype == torch.double


class TestNetworksThatDoNotFit:
    def test_two_outputs(self):
        network = TensorDictModule(
            nn.Linear(4, 2), in_keys=["observation"], out_keys=["demo_score"]
        )
        message = r"writes 'demo_score' of shape \[8, 5, 2\] .* one reward per step is \[8, 5, 1\]"
        with pytest.raises(ValueError, match=message):
            BradleyTerryLoss(network)(random_pairs(8))

    def test_no_dimension_for_the_output(self):
        network = TensorDictModule(
            lambda x: x.mean(-1), in_keys=["observation"], out_keys=["demo_score"]
        )
        with pytest.raises(ValueError, match=r"of shape \[8, 5\] .* one reward per step"):
            BradleyTerryLoss(network)(random_pairs(8))

    def test_another_output_key(self):
        network = model(out_key=("agent", "style"))
        loss, data = BradleyTerryLoss(network, beta=1.0), random_pairs(8)
        with pytest.raises(KeyError, match=r"set_keys\(score=\('agent', 'style'\)\)"):
            loss(data)
        loss.set_keys(score=("agent", "style"))
        total = [
            network(data[side])["agent", "style"].sum((-1, -2)) for side in ("preferred", "other")
        ]
        expected = nn.functional.softplus(total[1] - total[0]).mean()
        torch.testing.assert_close(loss(data)["loss_bradley_terry"], expected)

    @pytest.mark.parametrize("reduction", ["average", None])
    def test_unknown_reduction(self, reduction):
        with pytest.raises(ValueError, match="reduction must be one of"):
            BradleyTerryLoss(model(), reduction=reduction)

    def test_infinite_beta(self):
        with pytest.raises(ValueError, match="beta must be positive and finite, got inf"):
            BradleyTerryLoss(model(), beta=math.inf)
