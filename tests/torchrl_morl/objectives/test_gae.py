"""Advantages of every objective: numbers by hand, agreement with GAE, use with TorchRL's PPO."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from tensordict.nn.distributions import NormalParamExtractor
from torch import nn
from torchrl.modules import IndependentNormal, ProbabilisticActor
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from torchrl_morl.objectives import MultiObjectiveGAE
from torchrl_morl.preferences import PreferenceSpace

SPACE = PreferenceSpace(("core", "distance", "efficiency"), static={"core": 1.0})


def trajectories(*batch: int, num_objectives: int = 3, seed: int = 0) -> TensorDict:
    """Random ones, with ends in the middle, and a value for every objective."""
    generator = torch.Generator().manual_seed(seed)
    *_, steps = batch
    value = torch.randn(*batch[:-1], steps + 1, num_objectives, generator=generator)
    done = torch.rand(*batch, 1, generator=generator) < 0.2
    terminated = done & (torch.rand(*batch, 1, generator=generator) < 0.5)
    preference = torch.rand(*batch, 2, generator=generator)
    return TensorDict(
        observation=torch.randn(*batch, 4, generator=generator),
        preference=preference / preference.sum(-1, keepdim=True),
        state_value=value[..., :-1, :],
        next=TensorDict(
            observation=torch.randn(*batch, 4, generator=generator),
            state_value=value[..., 1:, :],
            reward=torch.randn(*batch, num_objectives, generator=generator),
            done=done,
            terminated=terminated,
            batch_size=batch,
        ),
        batch_size=batch,
    )


def make_gae(value_network=None, preference_space=SPACE, **kwargs) -> MultiObjectiveGAE:
    kwargs = {"gamma": 0.9, "lmbda": 0.8} | kwargs
    return MultiObjectiveGAE(
        value_network=value_network, preference_space=preference_space, **kwargs
    )


def test_hand_computed():
    # gamma = lmbda = 1/2. Errors of the values, objective 0: 1 + 4/2 - 2 = 1, then 3 - 4 = -1 at the
    # end; advantages 1 - 1/4 = 3/4 and -1. Objective 1: 0 + 0/2 + 2 = 2, then -4 - 0 = -4;
    # advantages 2 - 4/4 = 1 and -4.
    end = torch.tensor([[False], [True]])
    data = TensorDict(
        preference=torch.tensor([[0.25, 0.75], [0.25, 0.75]]),
        state_value=torch.tensor([[2.0, -2.0], [4.0, 0.0]]),
        next=TensorDict(
            state_value=torch.tensor([[4.0, 0.0], [100.0, 100.0]]),
            reward=torch.tensor([[1.0, 0.0], [3.0, -4.0]]),
            done=end,
            terminated=end,
            batch_size=2,
        ),
        batch_size=2,
    )
    make_gae(gamma=0.5, lmbda=0.5, preference_space=None)(data)
    expected = torch.tensor([[0.25 * 0.75 + 0.75 * 1.0], [0.25 * -1.0 + 0.75 * -4.0]])
    torch.testing.assert_close(data["advantage"], expected)
    torch.testing.assert_close(data["value_target"], torch.tensor([[2.75, -1.0], [3.0, -4.0]]))


def test_one_objective_is_gae():
    data = trajectories(5, 7, num_objectives=1)
    data["preference"] = torch.ones(5, 7, 1)
    expected = GAE(gamma=0.9, lmbda=0.8, value_network=None)(data.clone())
    result = make_gae(preference_space=None)(data)
    torch.testing.assert_close(result["advantage"], expected["advantage"])
    torch.testing.assert_close(result["value_target"], expected["value_target"])


@pytest.mark.parametrize("batch", [(6,), (4, 6), (2, 3, 6)])
def test_advantage_of_the_scalarized_reward(batch):
    data = trajectories(*batch)
    data["preference"] = data["preference"][..., :1, :].expand(*batch, 2).clone()
    weights = SPACE.weights(data["preference"])
    scalar = data.clone()
    for key in ("state_value", ("next", "state_value"), ("next", "reward")):
        scalar[key] = (weights * data[key]).sum(-1, keepdim=True)
    GAE(gamma=0.9, lmbda=0.8, value_network=None)(scalar)
    make_gae()(data)
    assert data["advantage"].shape == (*batch, 1)
    assert data["value_target"].shape == (*batch, 3)
    torch.testing.assert_close(data["advantage"], scalar["advantage"])


def test_truncation_bootstraps_and_termination_does_not():
    data = trajectories(1, 1)
    data["next", "done"] = torch.ones(1, 1, 1, dtype=torch.bool)
    reward, value, following = (
        data[key] for key in (("next", "reward"), "state_value", ("next", "state_value"))
    )
    for terminated, expected in ((False, reward + 0.9 * following), (True, reward)):
        data["next", "terminated"] = torch.full((1, 1, 1), terminated)
        make_gae()(data)
        torch.testing.assert_close(data["value_target"], expected)
        weights = SPACE.weights(data["preference"])
        torch.testing.assert_close(
            data["advantage"], (weights * (expected - value)).sum(-1, keepdim=True)
        )


def test_loop_and_convolution_agree():
    data = trajectories(3, 20)
    by_loop = make_gae(vectorized=False)(data.clone())
    at_once = make_gae(vectorized=True)(data.clone())
    torch.testing.assert_close(by_loop["advantage"], at_once["advantage"])


def test_standardises_the_scalar():
    data = trajectories(8, 30)
    plain = make_gae()(data.clone())["advantage"]
    standard = make_gae(average_gae=True)(data)["advantage"]
    torch.testing.assert_close(standard, (plain - plain.mean()) / plain.std(), atol=1e-4, rtol=0)


def test_levels_preferences():
    """Where "distance" is preferred rewards are five times as large, and advantages are not."""
    data = trajectories(64, 30)
    preference = torch.eye(2)[torch.arange(64) % 2]
    data["preference"] = preference[:, None].expand(64, 30, 2)
    factor = 1.0 + 4.0 * data["preference"][..., :1]
    data["state_value"] = data["state_value"] * factor
    data["next"].update({k: data["next", k] * factor for k in ("state_value", "reward")})
    plain = make_gae()(data.clone())["advantage"]
    level = make_gae(level_preferences=True)(data.clone())["advantage"]
    for rows in (preference[:, 0] > 0, preference[:, 0] == 0):
        expected = plain[rows] / plain[rows].abs().mean()
        torch.testing.assert_close(level[rows], expected, rtol=1e-4, atol=1e-5)


def test_leveling_is_bounded():
    """Nothing to learn at one of two preferences: its rounding errors stay small."""
    data = trajectories(2, 30)
    preference = torch.eye(2)
    data["preference"] = preference[:, None].expand(2, 30, 2)
    nearly_none = torch.tensor([1.0, 1e-6])[:, None, None]
    data["state_value"] = data["state_value"] * nearly_none
    data["next"].update({k: data["next", k] * nearly_none for k in ("state_value", "reward")})
    level = make_gae(level_preferences=True)(data)["advantage"]
    assert level[0].abs().mean() == pytest.approx(1.0, rel=1e-3)
    assert level[1].abs().max() < 1e-3
    data["next", "reward"].zero_()
    data["state_value"], data["next", "state_value"] = torch.zeros(2, 2, 30, 3)
    assert (make_gae(level_preferences=True)(data)["advantage"] == 0).all()


def test_levels_by_a_quadratic_form():
    """Rewards that are linear in the weights make advantages that are quadratic in them."""
    data = trajectories(4, 8, 30, num_objectives=2)
    weights = data["preference"]
    sign = torch.where(torch.arange(30) % 2 == 0, 1.0, -1.0)[:, None]
    # Episodes of one step: the advantage is sign (0.3 a^2 + 5 a b + b^2).
    data["next", "reward"] = sign * (weights @ torch.tensor([[0.3, 2.5], [2.5, 1.0]]))
    data["state_value"].zero_()
    data["next", "done"].fill_(True), data["next", "terminated"].fill_(True)
    data = make_gae(preference_space=None, level_preferences=True)(data)
    torch.testing.assert_close(data["advantage"], sign.expand(4, 8, 30, 1), rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(data["value_target"], data["next", "reward"])


def test_leveling_of_one_preference():
    data = trajectories(2, 5)
    data["preference"] = torch.tensor([0.25, 0.75]).expand(2, 5, 2)
    plain = make_gae()(data.clone())["advantage"]
    level = make_gae(level_preferences=True)(data.clone())["advantage"]
    torch.testing.assert_close(level, plain / plain.abs().mean(), rtol=1e-4, atol=1e-5)


def test_value_network_and_nested_keys():
    network = TensorDictModule(
        nn.Linear(4, 3), in_keys=["observation"], out_keys=[("critic", "value")]
    )
    data = trajectories(4, 6).exclude("state_value", ("next", "state_value"))
    data["user", "preference"] = data.pop("preference")
    gae = make_gae(network)
    gae.set_keys(
        value=("critic", "value"),
        preference=("user", "preference"),
        advantage=("ppo", "advantage"),
        value_target=("ppo", "target"),
    )
    assert ("user", "preference") in gae.in_keys
    gae(data)
    assert data["ppo", "advantage"].shape == (4, 6, 1)
    assert data["ppo", "target"].shape == (4, 6, 3)
    assert not data["ppo", "advantage"].requires_grad


def test_state_dict_and_schedule():
    gae = make_gae()
    assert set(gae.state_dict()) == {"gamma", "lmbda"}
    other = make_gae(gamma=0.1, lmbda=0.1)
    other.load_state_dict(gae.state_dict())
    data = trajectories(2, 5)
    torch.testing.assert_close(other(data.clone())["advantage"], gae(data)["advantage"])


@pytest.mark.parametrize("level", [False, True])
def test_compiles(level):
    data = trajectories(3, 6)
    expected = make_gae(level_preferences=level)(data.clone())["advantage"]
    compiled = torch.compile(make_gae(level_preferences=level), fullgraph=True)
    torch.testing.assert_close(compiled(data)["advantage"], expected)


def test_refuses_what_does_not_fit():
    with pytest.raises(ValueError, match="3 values need as many weights, got 2"):
        make_gae(preference_space=None)(trajectories(2, 3))
    data = trajectories(2, 3)
    data["next", "reward"] = data["next", "reward"][..., :2]
    with pytest.raises(ValueError, match="must have the same shape"):
        make_gae()(data)
    with pytest.raises(KeyError, match="not an accepted"):
        make_gae().set_keys(preferences="preference")


def test_with_clip_ppo():
    """One update of TorchRL's own loss raises the likelihood of what was better than expected."""
    torch.manual_seed(0)
    actor = ProbabilisticActor(
        TensorDictModule(
            nn.Sequential(nn.Linear(4, 4), NormalParamExtractor()),
            in_keys=["observation"],
            out_keys=["loc", "scale"],
        ),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )
    critic = TensorDictModule(nn.Linear(4, 3), in_keys=["observation"], out_keys=["state_value"])
    loss = ClipPPOLoss(actor, critic, entropy_bonus=False, loss_critic_type="l2")
    data = trajectories(16, 8).exclude("state_value", ("next", "state_value"))
    with torch.no_grad():
        actor(data)
    make_gae(critic)(data)
    batch = data.reshape(-1)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2)
    before = loss(batch)
    (before["loss_objective"] + before["loss_critic"]).backward()
    optimizer.step()
    after = loss(batch)
    assert after["loss_objective"] < before["loss_objective"]
    assert after["loss_critic"] < before["loss_critic"]
