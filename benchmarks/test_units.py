"""Times of single pieces, with pytest-benchmark: ``python -m pytest benchmarks/test_units.py``.

Not part of the tests: nothing is asserted about a time. Everything has the sizes of the recipe and
runs on one torch thread, eager; ``benchmarks.learner`` has the compiled updates.
"""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import step_mdp

from recipes.training.task import make_eval_env, make_preference_space, make_train_env
from torchrl_morl.deploy import LidarGeometry, PolicyRunner, load_policy
from torchrl_morl.evaluation import rollout_preferences

from . import POLICY
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


@pytest.fixture(scope="module")
def deployed():
    return load_policy(POLICY)


OBSERVED = {
    "preference": np.array([0.2, 0.3, 0.5]),
    "lidar": np.linspace(0.5, 4.0, 30),
    "goal": np.array([6.0, 0.5]),
    "human": np.array([2.0, 1.0]),
}


def test_bare_network_on_one_observation(benchmark, deployed):
    """The layers alone: what :func:`test_policy_act_on_one_observation` is measured by."""
    features = torch.randn(1, 39)
    with torch.inference_mode():
        assert benchmark(deployed.actor[0].module, features).isfinite().all()


def test_actor_on_one_observation(benchmark, deployed):
    """The same through its tensordict, as an environment calls it."""
    data = TensorDict(observation=torch.randn(1, 36), preference=torch.eye(3)[:1], batch_size=1)
    with torch.inference_mode():
        assert benchmark(deployed.actor, data)["action"].isfinite().all()


def test_policy_act_on_one_observation(benchmark, deployed):
    """Checks, features, network and physical units, numpy in and out."""
    assert np.isfinite(benchmark(deployed.act, **OBSERVED)).all()


def test_policy_runner_step(benchmark, deployed):
    """A scan of 1,081 beams, seen from another place, and all that."""
    lidar = LidarGeometry(-2.356, 0.00436, 1081, 0.1, 10.0, mount=(0.1, 0.0, 0.0))
    runner = PolicyRunner(deployed, lidar=lidar)
    ranges, clock = np.linspace(0.5, 9.0, 1081), itertools.count()

    def step():
        now = 0.2 * next(clock)
        return runner.step(
            ranges,
            goal=(6.0, 0.5),
            human=(2.0, 1.0),
            preference=(0.2, 0.3, 0.5),
            stamp=now,
            time=now,
        )

    assert benchmark(step).reason == "drive"
