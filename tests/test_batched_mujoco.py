"""Batched simulation: bit-equal to plain MuJoCo, isolated rows, exact snapshots, seeds and workers."""

from __future__ import annotations

import functools
import math
import pickle

import mujoco
import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import ParallelEnv, SerialEnv, StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs

from envs import ROBOTS, SCENES, BatchedMujocoEnv, NavigationEnv, Perturbation
from envs.mjcf import navigation_mjcf

# Few rays where the test is not about the lidar.
make_env = functools.partial(NavigationEnv, num_threads=1, num_rays=8, seed=0)


def _actions(env: NavigationEnv, steps: int, seed: int = 0) -> torch.Tensor:
    """Forward speed and turn rate over the whole range of the robot, ``[steps, N, 2]``."""
    unit = torch.rand(steps, env.num_envs, 2, generator=torch.Generator().manual_seed(seed))
    return env.action_spec.space.low + unit * (
        env.action_spec.space.high - env.action_spec.space.low
    )


def _drive(env, start: TensorDict, actions: torch.Tensor) -> list[TensorDict]:
    """What the environment returns for each action, without resets."""
    out, current = [], start
    for action in actions:
        current = env.step(current.set("action", action))["next"]
        out.append(current.clone())
    return out


def _assert_same(first, second, rows=slice(None)):
    for step, (a, b) in enumerate(zip(first, second, strict=True)):
        assert set(a.keys(True, True)) == set(b.keys(True, True))
        for key in a.keys(True, True):
            assert torch.equal(a[key][rows], b[key][rows]), (step, key)


class Swing(BatchedMujocoEnv):
    """The smallest subclass: a pendulum, rewarded for height and for saving torque."""

    FRAME_SKIP = 3

    def _make_model(self):
        return mujoco.MjModel.from_xml_string(
            """<mujoco><worldbody><body><joint name="hinge" axis="0 1 0"/>
            <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.03"/></body></worldbody>
            <actuator><motor joint="hinge"/></actuator></mujoco>"""
        )

    def _sample_initial_state(self, ids, tensordict):
        qpos = torch.rand(len(ids), 1, generator=self.rng, dtype=torch.float64)
        return qpos, torch.zeros_like(qpos)

    def _make_obs_spec(self):
        return Composite(
            angle=Unbounded((self.num_envs, 1), dtype=self.dtype), shape=(self.num_envs,)
        )

    def _make_obs(self, ids=None):
        rows = slice(None) if ids is None else ids
        return {"angle": self._view["qpos"][rows].to(self.dtype)}

    def _make_action_spec(self):
        return Bounded(-1.0, 1.0, shape=(self.num_envs, 1), dtype=self.dtype)

    def _make_reward_spec(self):
        return Unbounded((self.num_envs, 2), dtype=self.dtype)

    def _compute_terminated(self, state, next_state):
        return next_state.qpos.abs() > 1.5

    def _compute_reward(self, state, action, next_state):
        return torch.cat((-next_state.qpos.cos(), -action.square()), dim=-1)


# --- physics -----------------------------------------------------------------------------------


@pytest.mark.parametrize("num_threads", [1, 2])
@pytest.mark.parametrize("drive", ["planar", "wheels"])
@pytest.mark.parametrize("scene", ["static", "moving_human"])
def test_physics_is_bit_equal_to_a_loop_over_mj_step(scene, drive, num_threads):
    steps = 60 if drive == "planar" else 15
    env = make_env(num_envs=4, scene=scene, drive=drive, num_threads=num_threads)
    start = env.reset()
    # Put the robots next to their first box, facing it: contacts must agree too.
    box = start["scene", "boxes"][:, 0]
    offset = torch.tensor([0.4 + env.robot.radius, 0.0])
    if drive == "planar":
        start["qpos"][:, :2] = box[:, :2] - box[:, 3:4] * torch.tensor([1.0, 0.0]) - offset
        start["qpos"][:, 2] = 0.0
    start = env.reset(start, set_state=True)
    actions = _actions(env, steps)
    actions[: steps // 2, :, 0], actions[: steps // 2, :, 1] = env.robot.max_speed, 0.0
    batched = _drive(env, start.clone(), actions)

    contacts = 0
    for row in range(env.num_envs):
        model = mujoco.MjModel.from_xml_string(
            navigation_mjcf(env.robot, drive=drive, num_boxes=3, goal_radius=env.goal_radius)
        )
        data = mujoco.MjData(model)
        for i, (x, y, yaw, half_length, half_width) in enumerate(
            start["scene", "boxes"][row].tolist()
        ):
            model.geom(f"box{i}").size[:2] = half_length, half_width
            mocap = model.body(f"box{i}").mocapid[0]
            data.mocap_pos[mocap, :2] = x, y
            data.mocap_quat[mocap] = math.cos(yaw / 2), 0, 0, math.sin(yaw / 2)
        mujoco.mj_setConst(model, mujoco.MjData(model))
        data.qpos[:] = start["qpos"][row]
        human = model.body("human").mocapid[0]
        for step, action in enumerate(actions[:, row].double().tolist()):
            x, y, yaw = batched[step]["human_pose"][row].tolist()
            data.mocap_pos[human, :2] = x, y
            data.mocap_quat[human] = math.cos(yaw / 2), 0, 0, math.sin(yaw / 2)
            speed, turn = action
            if drive == "planar":
                data.ctrl[:] = speed, turn, 0.0
            else:
                half = env.robot.wheel_separation / 2
                data.ctrl[:] = speed - half * turn, speed + half * turn
                data.ctrl[:] /= env.robot.wheel_radius
            mujoco.mj_step(model, data, nstep=env.frame_skip)
            contacts += data.ncon
            assert batched[step]["qpos"][row].tolist() == data.qpos.tolist(), (row, step)
            assert batched[step]["qvel"][row].tolist() == data.qvel.tolist(), (row, step)
    assert contacts > 0


def test_a_minimal_subclass_follows_the_contract():
    env = Swing(num_envs=3, num_threads=1, seed=0, max_episode_steps=20)
    check_env_specs(env)
    assert env.frame_skip == 3
    rollout = env.rollout(20, break_when_any_done=False)
    assert rollout["next", "reward"].shape == (3, 20, 2)
    torch.testing.assert_close(
        rollout["next", "reward"][..., 0], -rollout["next", "qpos"][..., 0].cos().float()
    )
    assert torch.equal(rollout["next", "angle"], rollout["next", "qpos"].float())


def test_the_number_of_physics_steps_is_a_choice():
    coarse, fine = (Swing(num_envs=1, num_threads=1, seed=0, frame_skip=n) for n in (6, 3))
    action = torch.full((1, 1), 0.3)
    (once,) = _drive(coarse, coarse.reset(), action[None])
    twice = _drive(fine, fine.reset(), action.expand(2, 1, 1))
    assert torch.equal(once["qpos"], twice[-1]["qpos"])


# --- resets ------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(4,), (4, 1)], ids=["mask[N]", "mask[N,1]"])
@pytest.mark.parametrize("drive", ["planar", "wheels"])
def test_a_partial_reset_leaves_the_other_rows_alone(shape, drive):
    env, twin = (make_env(num_envs=4, drive=drive, scene="moving_human") for _ in range(2))
    actions = _actions(env, 16)
    before = _drive(env, env.reset(), actions[:6])[-1]
    reference = _drive(twin, twin.reset(), actions)
    mask = torch.tensor([False, True, False, True])
    kept, fresh = [0, 2], [1, 3]
    current = env.reset(before.clone().set("_reset", mask.reshape(shape)), set_state=False)
    for key in env.observation_spec.keys(True, True):
        assert torch.equal(current[key][kept], before[key][kept]), key
    assert (current["elapsed"][fresh] == 0).all() and (current["elapsed"][kept] == 6).all()
    for row in fresh:
        assert not torch.equal(current["scene", "boxes"][row], before["scene", "boxes"][row])
    _assert_same(_drive(env, current, actions[6:]), reference[6:], rows=kept)


def test_a_row_that_is_reset_carries_nothing_over():
    # The same scene must unfold the same way after another episode in the same row.
    env = make_env(num_envs=2, drive="wheels", perturbation=Perturbation(latency=1))
    start = env.reset()
    actions = _actions(env, 8)
    first = _drive(env, start.clone(), actions)
    env.set_seed(0)
    _assert_same(_drive(env, env.reset(), actions), first)


def test_an_empty_mask_resets_nothing():
    env = make_env(num_envs=2)
    before = _drive(env, env.reset(), _actions(env, 2))[-1]
    mask = torch.zeros(2, 1, dtype=torch.bool)
    after = env.reset(before.clone().set("_reset", mask), set_state=False)
    _assert_same([after.select(*before.keys())], [before])


@pytest.mark.parametrize("latency", [0, 1])
@pytest.mark.parametrize("drive", ["planar", "wheels"])
@pytest.mark.parametrize("wrap", [False, True], ids=["base", "transformed"])
@pytest.mark.parametrize("scene", ["static", "moving_human", "empty"])
def test_any_row_of_a_rollout_is_a_snapshot(scene, wrap, drive, latency):
    def make(seed):
        perturbation = Perturbation(latency=latency)
        env = make_env(num_envs=3, scene=scene, drive=drive, seed=seed, perturbation=perturbation)
        return TransformedEnv(env, StepCounter()) if wrap else env

    env = make(0)
    actions = _actions(env, 12)
    steps = _drive(env, env.reset(), actions)
    # Another environment, in the middle of another episode, takes the snapshot over.
    other = make(1)
    _drive(other, other.reset(), actions[:3])
    snapshot = steps[4].exclude("reward", "done", "terminated", "truncated")
    restored = other.reset(snapshot.clone(), set_state=True)
    for key in ("scan", "goal", "human", "pose", "qpos", "qvel", "elapsed"):
        assert torch.equal(restored[key], snapshot[key]), key
    continued = _drive(other, restored, actions[5:])
    if wrap:  # StepCounter counts from its own reset
        continued = [step.exclude("step_count") for step in continued]
        steps = [step.exclude("step_count") for step in steps]
    _assert_same(continued, steps[5:])


def test_what_was_returned_never_changes():
    # Results are new memory: neither later steps nor resets write into them.
    env = make_env(num_envs=3, scene="moving_human", max_episode_steps=4)
    current = env.reset()
    kept = [(current, current.clone())]
    for action in _actions(env, 10):
        step, current = env.step_and_maybe_reset(current.clone(False).set("action", action))
        kept += [(step, step.clone()), (current, current.clone())]
    for returned, copy in kept:
        _assert_same([returned], [copy])


def test_a_reset_says_that_nothing_has_ended():
    env = make_env(num_envs=3, max_episode_steps=1)
    flags = ("done", "terminated", "truncated")
    ended = _drive(env, env.reset(), _actions(env, 1))[-1]
    assert ended["done"].all()
    mask = torch.tensor([True, False, True])
    after = env.reset(ended.set("_reset", mask), set_state=False)
    for name in ("done", "truncated"):
        assert after[name].flatten().tolist() == [False, True, False]
    assert not after["terminated"].any()
    whole = env.reset()
    assert not any(whole[name].any() for name in flags)


def test_a_snapshot_can_be_restored_in_some_rows():
    env = make_env(num_envs=3)
    actions = _actions(env, 10)
    steps = _drive(env, env.reset(), actions)
    mask = torch.tensor([True, False, True])
    current = steps[-1].clone()
    current[mask] = steps[3][mask]
    current = env.reset(current.set("_reset", mask), set_state=True)
    assert current["elapsed"].squeeze(-1).tolist() == [4, 10, 4]
    again = _drive(env, current, actions[4:])
    _assert_same(again, steps[4:], rows=mask)


def test_an_incomplete_snapshot_is_refused():
    env = make_env(num_envs=2)
    row = env.reset().exclude("qpos", ("scene", "boxes"))
    with pytest.raises(ValueError, match=r"snapshot lacks \['qpos', 'scene.boxes'\]"):
        env.reset(row, set_state=True)


def test_without_snapshots_the_simulator_state_is_neither_observed_nor_settable():
    env = make_env(num_envs=2, snapshots=False, perturbation=Perturbation(latency=1))
    check_env_specs(env)
    env.set_seed(0)
    start = env.reset()
    assert not {"qpos", "qvel", "scene", "elapsed", "pending_action"} & set(start.keys())
    with pytest.raises(NotImplementedError, match="set_state"):
        env.reset(start, set_state=True)
    full = make_env(num_envs=2, perturbation=Perturbation(latency=1))
    actions = _actions(env, 5)
    lean, rich = _drive(env, start, actions), _drive(full, full.reset(), actions)
    _assert_same(lean, [step.select(*lean[0].keys()) for step in rich])


def test_a_rollout_resets_finished_rows_and_truncates():
    env = make_env(num_envs=3, max_episode_steps=7)
    rollout = env.rollout(
        20, lambda td: td.set("action", env.action_spec.zero()), break_when_any_done=False
    )
    expected = torch.tensor([(t + 1) % 7 == 0 for t in range(20)])
    assert torch.equal(rollout["next", "truncated"].squeeze(-1), expected.expand(3, 20))
    assert not rollout["next", "terminated"].any()
    assert torch.equal(rollout["next", "done"], rollout["next", "truncated"])
    assert rollout["elapsed"][0].squeeze(-1).tolist() == [t % 7 for t in range(20)]
    assert not torch.equal(rollout["scene", "goal"][:, 0], rollout["scene", "goal"][:, 7])


# --- specs, seeds, workers ---------------------------------------------------------------------


@pytest.mark.parametrize("drive", ["planar", "wheels"])
@pytest.mark.parametrize("robot", sorted(ROBOTS))
@pytest.mark.parametrize("scene", sorted(SCENES))
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
        {"perturbation": Perturbation(range_noise=0.1, dropout=0.1, velocity_noise=0.1, latency=1)},
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
    fault = Perturbation(range_noise=0.05, velocity_noise=0.05)
    envs = [make_env(num_envs=3, seed=seed, perturbation=fault) for seed in (5, 5, 6)]
    actions = _actions(envs[0], 5)
    first, again, other = ([env.reset(), *_drive(env, env.reset(), actions)] for env in envs)
    _assert_same(first, again)
    assert not torch.equal(first[0]["goal"], other[0]["goal"])
    # The second reset continues the stream instead of repeating it.
    assert not torch.equal(first[0]["goal"], first[1]["goal"])
    next_seed = envs[2].set_seed(5)
    assert next_seed not in (None, 5)
    _assert_same([envs[2].reset(), *_drive(envs[2], envs[2].reset(), actions)], first)
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
    fault = Perturbation(range_noise=0.05, dropout=0.1, velocity_noise=0.05, latency=1)
    env = make_env(num_envs=3, scene="moving_human", drive=drive, perturbation=fault)
    actions = _actions(env, 12)
    current = _drive(env, env.reset(), actions[:6])[-1]
    copy = pickle.loads(pickle.dumps(env))
    assert copy.batch is not env.batch
    pair = [_drive(each, current.clone(), actions[6:]) for each in (env, copy)]
    _assert_same(*pair)
    # The next scenes are the same too: the generators travelled along.
    _assert_same([env.reset()], [copy.reset()])


def test_serial_and_parallel_workers_agree():
    makers = [functools.partial(make_env, num_envs=2) for _ in range(2)]
    serial = SerialEnv(2, makers)
    parallel = ParallelEnv(2, makers, mp_start_method="fork")
    actions = torch.stack([_actions(makers[0](), 4, seed=i) for i in range(2)], dim=1)
    try:
        results = []
        for env in (serial, parallel):
            env.set_seed(3)
            start = env.reset()
            assert start.batch_size == (2, 2)
            assert not torch.equal(start["goal"][0], start["goal"][1])
            results.append([start.clone(), *_drive(env, start, actions)])
        _assert_same(*results)
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
        ({"num_threads": -1}, r"num_threads must be 0 \(every CPU\) or more, got -1"),
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
    assert (_drive(env, start, env.action_spec.zero()[None])[0]["elapsed"] == 1).all()


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
    actions = _actions(exact, 5).to(dtype)
    rollout = _drive(same, same.reset(), actions)
    expected = _drive(exact, exact.reset(), actions.double())
    for first, second in zip(rollout, expected, strict=True):
        for key in ("scan", "goal", "human", "reward"):
            assert torch.equal(first[key], second[key].to(dtype))
