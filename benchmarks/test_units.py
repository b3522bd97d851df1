"""Times of single pieces, with pytest-benchmark: ``python -m pytest benchmarks/test_units.py``.

Not part of the tests: nothing is asserted about a time. Everything has the sizes of the recipe and
runs on one torch thread, eager; ``benchmarks.learner`` has the compiled updates.
"""

from __future__ import annotations

import pytest
import torch
from torchrl.envs.utils import step_mdp

from recipes.training.task import make_eval_env, make_preference_space, make_train_env
from torchrl_morl.evaluation import rollout_preferences

from .ours import Ours
from .workload import config, transitions


@pytest.fixture(scope="module")
def cfg():
    torch.set_num_threads(1)
    torch.manual_seed(0)
    return config("compute.compile=false", "replay_buffer.size=100_000")


@pytest.fixture(scope="module")
def ours(cfg):
    learner = Ours(cfg, transitions(100_000))
    learner.update()
    return learner


def test_environment_step(benchmark, cfg):
    """All environments of the recipe once: physics, lidar, rewards, observation."""
    env = make_train_env(cfg, make_preference_space(with_demonstrations=False), None)
    data = env.reset()
    data["action"] = env.rand_action(data)["action"]

    def step():
        return step_mdp(env.step(data.copy()))

    assert benchmark(step)["observation"].shape[0] == cfg.env.num_envs
    env.close()


def test_sample_and_relabel(benchmark, ours):
    """One batch; the recipe draws several at once, which costs less for each."""
    size = ours.cfg.replay_buffer.batch_size
    assert len(benchmark(ours.replay_buffer.sample, size)) == size


def test_sample_and_relabel_for_several_updates(benchmark, ours):
    size = ours.cfg.optim.updates_per_batch * ours.cfg.replay_buffer.batch_size
    assert len(benchmark(ours.replay_buffer.sample)) == size


def test_critic_loss_forward(benchmark, ours):
    batch = ours.replay_buffer.sample(ours.cfg.replay_buffer.batch_size)
    loss, _ = benchmark(ours.loss.value_loss, batch)
    assert loss.isfinite()


def test_critic_loss_forward_and_backward(benchmark, ours):
    batch = ours.replay_buffer.sample(ours.cfg.replay_buffer.batch_size)

    def forward_and_backward():
        ours.optimizers["critic"].zero_grad(set_to_none=True)
        loss, _ = ours.loss.value_loss(batch)
        loss.backward()
        return loss

    assert benchmark(forward_and_backward).isfinite()


def test_actor_loss_forward_and_backward(benchmark, ours):
    batch = ours.replay_buffer.sample(ours.cfg.replay_buffer.batch_size)

    def forward_and_backward():
        ours.optimizers["actor"].zero_grad(set_to_none=True)
        loss, _ = ours.loss.actor_loss(batch)
        loss.backward()
        return loss

    assert benchmark(forward_and_backward).isfinite()


def test_soft_update_and_average(benchmark, ours):
    benchmark(ours._follow)


def test_evaluation_of_one_preference(benchmark, cfg, ours):
    """All episodes of one preference, batched; the policy is an untrained one."""
    preference_space = make_preference_space(with_demonstrations=True)
    env = make_eval_env(cfg, preference_space, None)

    def evaluate():
        return rollout_preferences(
            env,
            ours.actor,
            preference_space.corners()[:1],
            max_steps=cfg.env.max_episode_steps,
            seed=0,
        )

    data = benchmark.pedantic(evaluate, rounds=3, iterations=1)
    assert data.shape[:2] == (1, cfg.evaluation.episodes)
    env.close()
