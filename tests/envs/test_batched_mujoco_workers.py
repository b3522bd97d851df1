"""Batched simulation as an environment of TorchRL: specs, seeds, workers and bad input."""

from __future__ import annotations

import functools
import gc
import math
import multiprocessing
import pickle

import pytest
import torch
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.envs import ParallelEnv, SerialEnv
from torchrl.envs.utils import check_env_specs

from envs import ROBOTS, SCENES, Faults, NavigationEnv
from envs.catalogue import MET
from tests._batched_mujoco import Swing, assert_same, follow, make_env, random_actions


@pytest.mark.parametrize("drive", ["planar", "wheels"])
@pytest.mark.parametrize("robot", sorted(ROBOTS))
@pytest.mark.parametrize("scene", sorted(SCENES.keys() - MET.keys()))
def test_specs(scene, robot, drive):
    env = NavigationEnv(num_envs=2, num_threads=1, scene=scene, robot=robot, drive=drive, seed=0)
    check_env_specs(env)
    assert env.batch_size == (2,)


@pytest.mark.parametrize(
    "kwargs",
    [
        {"num_envs": 1},
        {"dtype": torch.float64},
        {"device": "cpu"},
        {"faults": Faults(range_noise=0.1, dropout=0.1, velocity_noise=0.1, latency=1)},
    ],
    ids=lambda kwargs: next(iter(kwargs)),
)
def test_specs_of_options(kwargs):
    env = make_env(**{"num_envs": 2, **kwargs})
    check_env_specs(env)
    step = env.rand_step(env.reset())
    dtype = kwargs.get("dtype", torch.float32)
    assert (
        step["next", "scan"].dtype == step["next", "reward"].dtype == step["action"].dtype == dtype
    )
    assert step["next", "pose"].dtype == torch.float64


@pytest.mark.parametrize("device", [None, "cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def test_everything_observed_is_on_the_device(device):
    env = make_env(num_envs=3, device=device)
    rollout = env.rollout(4)
    assert env.device == (None if device is None else torch.device(device))
    assert {value.device.type for value in rollout.values(True, True)} == {device or "cpu"}
    restored = env.reset(rollout[:, 2].exclude("next"), set_state=True)
    assert torch.equal(restored["pose"], rollout["pose"][:, 2])


def test_a_seed_fixes_everything_and_seeds_differ():
    fault = Faults(range_noise=0.05, velocity_noise=0.05)
    envs = [make_env(num_envs=3, seed=seed, faults=fault) for seed in (5, 5, 6)]
    actions = random_actions(envs[0], 5)
    first, again, other = ([env.reset(), *follow(env, env.reset(), actions)] for env in envs)
    assert_same(first, again)
    assert not torch.equal(first[0]["goal"], other[0]["goal"])
    # The second reset continues the stream instead of repeating it.
    assert not torch.equal(first[0]["goal"], first[1]["goal"])
    next_seed = envs[2].set_seed(5)
    assert next_seed not in (None, 5)
    assert_same([envs[2].reset(), *follow(envs[2], envs[2].reset(), actions)], first)
    assert envs[2].set_seed(5, static_seed=True) == 5


def test_without_a_seed_environments_differ_and_the_callers_generator_is_left_alone():
    before = torch.get_rng_state()
    first, second = (make_env(num_envs=1, seed=None) for _ in range(2))
    assert not torch.equal(first.reset()["goal"], second.reset()["goal"])
    assert torch.equal(torch.get_rng_state(), before)


def test_threads_of_torch_are_left_alone():
    threads = torch.get_num_threads()
    make_env(num_envs=2, num_threads=2).rollout(2)
    assert torch.get_num_threads() == threads == 1


@pytest.mark.parametrize("drive", ["planar", "wheels"])
def test_pickling_continues_bit_for_bit(drive):
    fault = Faults(range_noise=0.05, dropout=0.1, velocity_noise=0.05, latency=1)
    env = make_env(num_envs=3, scene="moving_human", drive=drive, faults=fault)
    actions = random_actions(env, 12)
    current = follow(env, env.reset(), actions[:6])[-1]
    copy = pickle.loads(pickle.dumps(env))
    assert copy.batch is not env.batch
    pair = [follow(each, current.clone(), actions[6:]) for each in (env, copy)]
    assert_same(*pair)
    # The next scenes are the same too: the generators travelled along.
    assert_same([env.reset()], [copy.reset()])


def test_a_forked_process_may_collect_what_its_parent_left():
    class Garbage:
        """In a cycle: only the garbage collector ends it."""

    gc.collect()
    gc.disable()
    try:
        left = Garbage()
        left.itself, left.env = left, make_env(num_envs=4, num_threads=2)
        left.env.rollout(2)
        del left
        child = multiprocessing.get_context("fork").Process(target=gc.collect)
        child.start()
        child.join(60)
        ended = child.exitcode
        child.kill()
    finally:
        gc.enable()
    assert ended == 0


def test_serial_and_parallel_workers_agree():
    makers = [functools.partial(make_env, num_envs=2) for _ in range(2)]
    serial = SerialEnv(2, makers)
    parallel = ParallelEnv(2, makers, mp_start_method="fork")
    actions = torch.stack([random_actions(makers[0](), 4, seed=i) for i in range(2)], dim=1)
    try:
        results = []
        for env in (serial, parallel):
            env.set_seed(3)
            start = env.reset()
            assert start.batch_size == (2, 2)
            assert not torch.equal(start["goal"][0], start["goal"][1])
            results.append([start.clone(), *follow(env, start, actions)])
        assert_same(*results)
    finally:
        parallel.close()
        serial.close()


def test_collector():
    collector = Collector(
        functools.partial(make_env, num_envs=4, max_episode_steps=5),
        policy=None,
        frames_per_batch=32,
        total_frames=64,
    )
    batches = list(collector)
    collector.shutdown()
    assert [tuple(batch.shape) for batch in batches] == [(4, 8), (4, 8)]
    assert batches[0]["next", "truncated"][:, 4].all()
    assert (batches[0]["elapsed"][:, 5] == 0).all()


def test_collector_in_two_processes():
    maker = functools.partial(make_env, num_envs=2, snapshots=False)
    collector = MultiSyncCollector(
        [maker, maker], policy=None, frames_per_batch=16, total_frames=16, cat_results=0
    )
    try:
        collector.set_seed(7)
        (batch,) = list(collector)
    finally:
        collector.shutdown()
    assert batch.shape == (4, 4)
    assert batch["next", "reward"].shape == (4, 4, 3)
    goals = batch["goal"][:, 0]
    assert torch.unique(goals, dim=0).shape == goals.shape


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"num_envs": 0}, "num_envs must be at least 1, got 0"),
        ({"num_envs": -3}, "num_envs must be at least 1, got -3"),
        ({"max_episode_steps": 0}, "max_episode_steps must be at least 1, got 0"),
        ({"num_threads": -1}, "num_threads must be at least 0, got -1"),
    ],
)
def test_sizes_are_checked(kwargs, message):
    with pytest.raises(ValueError, match=message):
        make_env(**kwargs)


def test_frame_skip_is_checked():
    with pytest.raises(ValueError, match="frame_skip must be at least 1, got 0"):
        Swing(frame_skip=0)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_an_action_that_is_not_finite_names_its_environment(bad):
    env = make_env(num_envs=3)
    start = env.reset()
    action = env.action_spec.zero()
    action[1, 0] = bad
    with pytest.raises(ValueError, match=r"action of environment 1 is \[(nan|inf), 0.0\]"):
        env.step(start.clone().set("action", action))
    # Nothing happened: the episode can go on.
    assert (follow(env, start, env.action_spec.zero()[None])[0]["elapsed"] == 1).all()


def test_huge_actions_are_finite():
    env = make_env(num_envs=3)
    action = torch.full((3, 2), torch.finfo(env.dtype).max)  # their sum is infinite
    assert env.step(env.reset().set("action", action))["next", "qpos"].isfinite().all()


def test_actions_may_require_gradients():
    env = make_env(num_envs=3)
    action = env.action_spec.rand().requires_grad_()
    rollout = env.step(env.reset().set("action", action))
    assert not any(value.requires_grad for value in rollout["next"].values(True, True))


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
def test_types_of_observations(dtype):
    """NumPy lacks one of them."""
    same, exact = (make_env(num_envs=3, dtype=kind) for kind in (dtype, torch.float64))
    actions = random_actions(exact, 5).to(dtype)
    rollout = follow(same, same.reset(), actions)
    expected = follow(exact, exact.reset(), actions.double())
    for first, second in zip(rollout, expected, strict=True):
        for key in ("scan", "goal", "human", "reward"):
            assert torch.equal(first[key], second[key].to(dtype))
