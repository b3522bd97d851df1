"""Batched simulation: bit-equal to plain MuJoCo, isolated rows, exact snapshots."""

from __future__ import annotations

import math

import mujoco
import pytest
import torch
from torchrl.envs import StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs

from envs import Faults
from envs.mjcf import navigation_mjcf
from tests._batched_mujoco import Swing, assert_same, follow, make_env, random_actions

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
    actions = random_actions(env, steps)
    actions[: steps // 2, :, 0], actions[: steps // 2, :, 1] = env.robot.max_speed, 0.0
    batched = follow(env, start.clone(), actions)

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
            data.ctrl[:2] = action
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
    (once,) = follow(coarse, coarse.reset(), action[None])
    twice = follow(fine, fine.reset(), action.expand(2, 1, 1))
    assert torch.equal(once["qpos"], twice[-1]["qpos"])


# --- resets ------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(4,), (4, 1)], ids=["mask[N]", "mask[N,1]"])
@pytest.mark.parametrize("drive", ["planar", "wheels"])
def test_a_partial_reset_leaves_the_other_rows_alone(shape, drive):
    env, twin = (make_env(num_envs=4, drive=drive, scene="moving_human") for _ in range(2))
    actions = random_actions(env, 16)
    before = follow(env, env.reset(), actions[:6])[-1]
    reference = follow(twin, twin.reset(), actions)
    mask = torch.tensor([False, True, False, True])
    kept, fresh = [0, 2], [1, 3]
    current = env.reset(before.clone().set("_reset", mask.reshape(shape)), set_state=False)
    for key in env.observation_spec.keys(True, True):
        assert torch.equal(current[key][kept], before[key][kept]), key
    assert (current["elapsed"][fresh] == 0).all() and (current["elapsed"][kept] == 6).all()
    for row in fresh:
        assert not torch.equal(current["scene", "boxes"][row], before["scene", "boxes"][row])
    assert_same(follow(env, current, actions[6:]), reference[6:], rows=kept)


def test_a_row_that_is_reset_carries_nothing_over():
    # The same scene must unfold the same way after another episode in the same row.
    env = make_env(num_envs=2, drive="wheels", faults=Faults(latency=1))
    start = env.reset()
    actions = random_actions(env, 8)
    first = follow(env, start.clone(), actions)
    env.set_seed(0)
    assert_same(follow(env, env.reset(), actions), first)


def test_an_empty_mask_resets_nothing():
    env = make_env(num_envs=2)
    before = follow(env, env.reset(), random_actions(env, 2))[-1]
    mask = torch.zeros(2, 1, dtype=torch.bool)
    after = env.reset(before.clone().set("_reset", mask), set_state=False)
    assert_same([after.select(*before.keys())], [before])


@pytest.mark.parametrize("latency", [0, 1])
@pytest.mark.parametrize("drive", ["planar", "wheels"])
@pytest.mark.parametrize("wrap", [False, True], ids=["base", "transformed"])
@pytest.mark.parametrize("scene", ["static", "moving_human", "empty"])
def test_any_row_of_a_rollout_is_a_snapshot(scene, wrap, drive, latency):
    def make(seed):
        faults = Faults(latency=latency)
        env = make_env(num_envs=3, scene=scene, drive=drive, seed=seed, faults=faults)
        return TransformedEnv(env, StepCounter()) if wrap else env

    env = make(0)
    actions = random_actions(env, 12)
    steps = follow(env, env.reset(), actions)
    # Another environment, in the middle of another episode, takes the snapshot over.
    other = make(1)
    follow(other, other.reset(), actions[:3])
    snapshot = steps[4].exclude("reward", "done", "terminated", "truncated")
    restored = other.reset(snapshot.clone(), set_state=True)
    for key in ("scan", "goal", "human", "pose", "qpos", "qvel", "elapsed"):
        assert torch.equal(restored[key], snapshot[key]), key
    continued = follow(other, restored, actions[5:])
    if wrap:  # StepCounter counts from its own reset
        continued = [step.exclude("step_count") for step in continued]
        steps = [step.exclude("step_count") for step in steps]
    assert_same(continued, steps[5:])


def test_what_was_returned_never_changes():
    # Results are new memory: neither later steps nor resets write into them.
    env = make_env(num_envs=3, scene="moving_human", max_episode_steps=4)
    current = env.reset()
    kept = [(current, current.clone())]
    for action in random_actions(env, 10):
        step, current = env.step_and_maybe_reset(current.clone(False).set("action", action))
        kept += [(step, step.clone()), (current, current.clone())]
    for returned, copy in kept:
        assert_same([returned], [copy])


def test_a_reset_says_that_nothing_has_ended():
    env = make_env(num_envs=3, max_episode_steps=1)
    flags = ("done", "terminated", "truncated")
    ended = follow(env, env.reset(), random_actions(env, 1))[-1]
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
    actions = random_actions(env, 10)
    steps = follow(env, env.reset(), actions)
    mask = torch.tensor([True, False, True])
    current = steps[-1].clone()
    current[mask] = steps[3][mask]
    current = env.reset(current.set("_reset", mask), set_state=True)
    assert current["elapsed"].squeeze(-1).tolist() == [4, 10, 4]
    again = follow(env, current, actions[4:])
    assert_same(again, steps[4:], rows=mask)


def test_an_incomplete_snapshot_is_refused():
    env = make_env(num_envs=2)
    row = env.reset().exclude("qpos", ("scene", "boxes"))
    with pytest.raises(ValueError, match=r"snapshot lacks \['qpos', 'scene.boxes'\]"):
        env.reset(row, set_state=True)


def test_without_snapshots_the_simulator_state_is_neither_observed_nor_settable():
    env = make_env(num_envs=2, snapshots=False, faults=Faults(latency=1))
    check_env_specs(env)
    env.set_seed(0)
    start = env.reset()
    assert not {"qpos", "qvel", "scene", "elapsed", "pending_action"} & set(start.keys())
    with pytest.raises(NotImplementedError, match="set_state"):
        env.reset(start, set_state=True)
    full = make_env(num_envs=2, faults=Faults(latency=1))
    actions = random_actions(env, 5)
    lean, rich = follow(env, start, actions), follow(full, full.reset(), actions)
    assert_same(lean, [step.select(*lean[0].keys()) for step in rich])


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
