"""MO-PPO: one policy for all preferences, of continuous or discrete actions."""

from __future__ import annotations

import torch
from omegaconf import DictConfig
from tensordict.nn import (
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictSequential,
)
from torch import Tensor
from torch.distributions import Categorical
from torchrl.data import Bounded

from recipes.training import agent, on_policy, ppo
from recipes.training.evaluation import observation_size
from recipes.training.ppo_optimizers import make_optimizers
from torchrl_morl.modules import make_actor

from .lattice import CHOICE, LatticeEvaluation
from .problem import BenchmarkProblem

_LOGIT_RANGE = 10.0


def train(cfg: DictConfig, problem: BenchmarkProblem) -> None:
    """Train from nothing, as :mod:`recipes.mo_ppo.mo_ppo` does, without what is about driving."""
    sigma = None
    if problem.num_actions is None:
        actor = agent.make_actor(cfg, problem)
        spec = problem.env.action_spec_unbatched
        sigma = torch.full(spec.shape, cfg.collector.exploration_sigma, device=problem.device)
        likely, policy = ppo.make_policy(actor, sigma)
    else:
        actor = make_choosing_actor(cfg, problem, problem.num_actions)
        likely, policy = make_choosing_policy(actor)
    critic = ppo.make_critic(cfg, problem)
    loss = ppo.make_loss(
        cfg,
        likely,
        critic,
        entropy_coeff=None if problem.num_actions is None else cfg.loss.entropy_coeff,
    )
    on_policy.train(
        cfg,
        problem,
        policy,
        actor,
        agent.make_averaged(cfg, actor),
        ppo.make_advantage(cfg, problem, critic),
        loss,
        make_optimizers(cfg, loss),
        evaluation=LatticeEvaluation(cfg, problem),
        sigma=sigma,
    )


def make_choosing_actor(
    cfg: DictConfig, problem: BenchmarkProblem, num_actions: int
) -> TensorDictSequential:
    """An actor of discrete actions: it writes ``choice`` in [-1, 1], how much it is for each of them."""
    actor = make_actor(
        Bounded(-1.0, 1.0, (num_actions,)),
        in_features=observation_size(problem) + problem.preference_space.num_tunable,
        num_cells=cfg.network.num_cells,
        out_key=CHOICE,
        device=problem.device,
    )
    return agent.standardized(actor, problem)


def make_choosing_policy(
    actor: TensorDictSequential,
) -> tuple[ProbabilisticTensorDictSequential, TensorDictSequential]:
    """Draws an action, with logits that are ten times the actor's ``choice``.

    Logits within a range keep a probability for every action, as in Bello et al.
    (https://arxiv.org/abs/1611.09940, A.1), and the actor is of the kind that policy folders hold.

    Returns:
        The probabilistic part, which writes ``noisy_action``; and that followed by ``action``.
    """
    likely = ProbabilisticTensorDictSequential(
        actor,
        TensorDictModule(_logits, in_keys=[CHOICE], out_keys=["logits"]),
        ProbabilisticTensorDictModule(
            in_keys=["logits"],
            out_keys=["noisy_action"],
            distribution_class=Categorical,
            return_log_prob=True,
        ),
    )
    drawn = TensorDictModule(torch.clone, in_keys=["noisy_action"], out_keys=["action"])
    return likely, TensorDictSequential(likely, drawn)


def _logits(choice: Tensor) -> Tensor:
    return _LOGIT_RANGE * choice
