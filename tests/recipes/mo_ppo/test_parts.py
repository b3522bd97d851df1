"""The parts of MO-PPO by hand: its policy, its gradients, precision and what it saves."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest
import torch
from hydra import compose, initialize_config_module
from omegaconf import DictConfig
from tensordict import TensorDict
from torchrl.checkpoint import Checkpoint
from torchrl.data import Bounded
from torchrl.envs.utils import ExplorationType, set_exploration_type

from envs import NavigationEnv
from recipes.mo_ppo import penalties
from recipes.mo_ppo.batches import BATCH, failing, failure_rate
from recipes.training import ppo
from recipes.training.ppo import make_advantage, make_loss, make_policy
from torchrl_morl import PreferenceSpace
from torchrl_morl.modules import make_actor, make_vector_critic
from torchrl_morl.objectives import MultiObjectiveGAE

SPACE = PreferenceSpace(NavigationEnv.objectives, static={"core": 1.0})


def configuration(*overrides: str) -> DictConfig:
    with initialize_config_module("recipes.mo_ppo", version_base="1.3"):
        return compose("config", overrides=list(overrides))


def test_likelihood_and_bounds():
    actor = make_actor(Bounded(-1.0, 1.0, (2,)), in_features=4 + 2, num_cells=(8,))
    noisy, policy = make_policy(actor, torch.tensor([0.5, 0.25]))
    data = TensorDict(
        observation=torch.randn(200, 4), preference=torch.rand(200, 2), batch_size=[200]
    )
    with set_exploration_type(ExplorationType.RANDOM), torch.no_grad():
        drawn = policy(data.clone())
        mean = actor(data.clone())["action"]
    z = (drawn["noisy_action"] - mean) / torch.tensor([0.5, 0.25])
    expected = -0.5 * z.square().sum(-1) - math.log(0.5) - math.log(0.25) - math.log(2 * math.pi)
    torch.testing.assert_close(drawn["noisy_action_log_prob"], expected)
    torch.testing.assert_close(drawn["action"], drawn["noisy_action"].clamp(-1, 1))
    assert (drawn["noisy_action"].abs() > 1).any()
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        torch.testing.assert_close(noisy(data.clone())["noisy_action"], mean)


def test_failures_are_the_episodes_that_end_elsewhere():
    def rate(done: list[bool], success: list[bool]) -> float:
        ends = TensorDict(done=torch.tensor(done), success=torch.tensor(success), batch_size=[4])
        return failure_rate(TensorDict(next=ends, batch_size=[4])).item()

    assert rate([True, True, False, True], [True, False, False, True]) == pytest.approx(1 / 3)
    assert math.isnan(rate([False] * 4, [False] * 4))


def test_what_leads_to_a_failure_is_known():
    # An environment a row: arrives at its third step, then fails at its fifth, and goes on; drives on.
    done = torch.tensor([[0, 0, 1, 0, 1, 0], [0] * 6], dtype=torch.bool).unsqueeze(-1)
    success = torch.tensor([[0, 0, 1, 0, 0, 0], [0] * 6], dtype=torch.bool).unsqueeze(-1)
    data = TensorDict(
        collector=TensorDict(traj_ids=torch.tensor([[0, 0, 0, 2, 2, 3], [1] * 6])),
        next=TensorDict(done=done, success=success, batch_size=[2, 6]),
        batch_size=[2, 6],
    )
    expected = torch.tensor([[0, 0, 0, 1, 1, 0], [0] * 6], dtype=torch.bool)
    assert torch.equal(failing(data), expected)


def test_bfloat16_rounds_layers_and_not_actions():
    torch.manual_seed(0)
    actor = make_actor(Bounded(-1.0, 1.0, (2,)), in_features=4 + 2, num_cells=(8, 8))
    with torch.no_grad():
        actor[0].module[-1].bias.fill_(3.0)  # tanh 0.9951, between two numbers of bfloat16
    noisy, _ = make_policy(actor, torch.tensor([0.1, 0.1]))
    data = TensorDict(observation=torch.randn(50, 4), preference=torch.rand(50, 2), batch_size=[50])
    exact = actor(data.clone())["action"]
    with torch.autocast("cpu", torch.bfloat16):
        rounded = actor(data.clone())
        density = noisy.get_dist(data.clone()).log_prob(exact)
    assert rounded["action"].dtype == rounded["pre_tanh"].dtype == density.dtype == torch.float32
    assert not torch.equal(rounded["action"], exact)
    torch.testing.assert_close(rounded["action"], exact, atol=3e-4, rtol=0)


def test_gradients_go_where_they_belong():
    torch.manual_seed(0)
    actor = make_actor(Bounded(-1.0, 1.0, (2,)), in_features=4 + 2, num_cells=(8,))
    noisy, policy = make_policy(actor, torch.tensor([0.1, 0.1]))
    critic = make_vector_critic(
        3,
        in_features=4 + 2,
        in_keys=("observation", "preference"),
        num_cells=(8,),
        out_key="state_value",
    )
    loss = make_loss(configuration(), noisy, critic)
    data = TensorDict(
        observation=torch.randn(6, 8, 4),
        preference=torch.tensor([0.5, 0.5]).expand(6, 8, 2),
        next=TensorDict(
            observation=torch.randn(6, 8, 4),
            preference=torch.tensor([0.5, 0.5]).expand(6, 8, 2),
            reward=torch.randn(6, 8, 3),
            done=torch.zeros(6, 8, 1, dtype=torch.bool),
            terminated=torch.zeros(6, 8, 1, dtype=torch.bool),
            batch_size=[6, 8],
        ),
        batch_size=[6, 8],
    )
    with set_exploration_type(ExplorationType.RANDOM), torch.no_grad():
        policy(data)
    MultiObjectiveGAE(gamma=0.9, lmbda=0.8, value_network=critic, preference_space=SPACE)(data)
    data["start_action"] = torch.zeros(6, 8, 2)
    data["human"] = torch.ones(6, 8, 2)
    data["fails"] = torch.zeros(6, 8, dtype=torch.bool)
    batch = data.reshape(-1).select(*BATCH)
    losses = loss(batch)

    def trained(value: torch.Tensor) -> set[str]:
        loss.zero_grad()
        value.backward(retain_graph=True)
        return {
            name.split("_network")[0]
            for name, parameter in loss.named_parameters()
            if parameter.grad is not None and parameter.grad.any()
        }

    assert trained(losses["loss_objective"]) == {"actor"}
    assert trained(losses["loss_critic"]) == {"critic"}
    action = actor(batch.select(*actor.in_keys))["action"]
    assert trained(penalties.smoothness(batch, action, actor)) == {"actor"}
    sigma = torch.tensor([0.5, 0.1])
    held = penalties.anchor(batch, action, sigma=sigma, objective=0, radius=2.5)
    assert trained(held) == {"actor"}


def test_values_do_not_depend_on_how_many_environments_are_evaluated_at_once(monkeypatch):
    torch.manual_seed(0)
    critic = make_vector_critic(
        3, in_features=4 + 2, in_keys=("observation", "preference"), out_key="state_value"
    )
    ends = torch.rand(5, 8, 1) < 0.2
    following = TensorDict(
        observation=torch.randn(5, 8, 4),
        preference=torch.rand(5, 8, 2),
        reward=torch.randn(5, 8, 3),
        done=ends,
        terminated=ends,
    )
    data = TensorDict(
        observation=torch.randn(5, 8, 4), preference=SPACE.sample((5, 8)), batch_size=[5, 8]
    )
    data["next"] = following.auto_batch_size_(2)
    task = SimpleNamespace(preference_space=SPACE, device=torch.device("cpu"))
    results = []
    for number in (2, 5):
        monkeypatch.setattr(ppo, "ENVS_AT_ONCE", number)
        results.append(make_advantage(configuration(), task, critic)(data.clone()))
    assert results[0]["advantage"].std() > 0.1
    for key in ("advantage", "value_target"):
        torch.testing.assert_close(results[0][key], results[1][key])


def test_a_loaded_loss_is_the_policy_that_collects(tmp_path):
    def made(seed: int):
        torch.manual_seed(seed)
        actor = make_actor(Bounded(-1.0, 1.0, (2,)), in_features=4 + 2, num_cells=(8,))
        noisy, policy = make_policy(actor, torch.tensor([0.1, 0.1]))
        critic = make_vector_critic(
            3, in_features=4 + 2, in_keys=("observation", "preference"), out_key="state_value"
        )
        return actor, policy, make_loss(configuration(), noisy, critic)

    saved, _, loss = made(0)
    Checkpoint(loss=loss).save(tmp_path / "checkpoint")
    loaded, policy, loss = made(1)
    Checkpoint(loss=loss).load(tmp_path / "checkpoint")
    for name, value in saved.state_dict().items():
        torch.testing.assert_close(loaded.state_dict()[name], value, rtol=0, atol=0)
    data = TensorDict(observation=torch.randn(5, 4), preference=torch.rand(5, 2), batch_size=[5])
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        torch.testing.assert_close(
            policy(data.clone())["action"], saved(data.clone())["action"].clamp(-1, 1)
        )
