"""The tasks of PGMORL: models, rewards and ends as in its code."""

from __future__ import annotations

from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import pytest
from gymnasium.envs.mujoco import mujoco_env
from torchrl.envs.utils import check_env_specs

from envs import pgmorl
from envs.mo_gym import make_mo_gym_env

TASKS = {
    "MO-HalfCheetah-v2": (17, 6, 2),
    "MO-Walker2d-v2": (17, 6, 2),
    "MO-Ant-v2": (27, 8, 2),
    "MO-Swimmer-v2": (8, 2, 2),
    "MO-Hopper-v2": (11, 3, 2),
    "MO-Hopper-v3": (11, 3, 3),
}

CHANGES = {
    "half_cheetah.xml": {},
    "walker2d.xml": {'damping=".1"': 'damping="3.0"', 'density="1000"': 'density="1500"'},
    "ant.xml": {'gear="150"': 'gear="100"'},
    "swimmer.xml": {'gear="150.0"': 'gear="300.0"'},
    "hopper.xml": {
        'damping="1" limited="true"': 'damping="40" limited="false"',
        'ctrlrange="-1.0 1.0" gear="200.0" joint="foot': 'ctrlrange="-4 4" gear="300" joint="foot',
        'ctrlrange="-1.0 1.0"': 'ctrlrange="-2 2"',
    },
}
"""What PGMORL's own files have in place of Gymnasium's."""

ARRAYS = (
    "body_mass",
    "body_inertia",
    "body_subtreemass",
    "body_invweight0",
    "dof_armature",
    "dof_damping",
    "dof_invweight0",
    "dof_M0",
    "jnt_limited",
    "actuator_gear",
    "actuator_ctrlrange",
    "actuator_acc0",
)


def make(name: str, **kwargs) -> gymnasium.Env:
    env = gymnasium.make(name, disable_env_checker=True, **kwargs)
    env.reset(seed=0)
    return env


@pytest.mark.parametrize(
    "task",
    [pgmorl.MOHalfCheetah, pgmorl.MOWalker2d, pgmorl.MOAnt, pgmorl.MOSwimmer, pgmorl.MOHopper],
)
def test_models_are_those_of_pgmorl(task):
    text = (Path(mujoco_env.__file__).parent / "assets" / task.model_file).read_text()
    for found, wanted in CHANGES[task.model_file].items():
        assert found in text
        text = text.replace(found, wanted)
    wanted, env = mujoco.MjModel.from_xml_string(text), task()
    for name in ARRAYS:
        np.testing.assert_allclose(
            getattr(env.model, name), getattr(wanted, name), rtol=1e-9, err_msg=name
        )


@pytest.mark.parametrize(("name", "sizes"), TASKS.items())
def test_spaces(name, sizes):
    env = make(name).unwrapped
    found = (env.observation_space.shape, env.action_space.shape, env.reward_space.shape)
    assert found == tuple((size,) for size in sizes)
    assert env.observation_space.contains(env.reset(seed=1)[0])
    assert gymnasium.spec(name).max_episode_steps == 500


@pytest.mark.parametrize("name", TASKS)
def test_specs_as_a_policy_sees_it(name):
    env = make_mo_gym_env(f"envs.pgmorl:{name}", num_envs=2)
    check_env_specs(env)


def test_speed_is_the_way_over_the_time():
    env = make("MO-HalfCheetah-v2").unwrapped
    before = env.data.qpos[0]
    for _ in range(10):
        _, reward, *_ = env.step(np.full(6, 0.5))
        speed = (env.data.qpos[0] - before) / 0.05
        assert reward[0] == pytest.approx(speed + 1, rel=1e-5)
        assert reward[1] == pytest.approx(5 - 6 * 0.25)
        before = env.data.qpos[0]


def test_no_more_than_four_metres_a_second_count():
    env = make("MO-HalfCheetah-v2").unwrapped
    velocity = env.init_qvel.copy()
    velocity[0] = 9.0
    env.set_state(env.init_qpos, velocity)
    assert env.step(np.zeros(6))[1][0] == 5.0


@pytest.mark.parametrize(
    ("name", "action", "effort"),
    [
        ("MO-Walker2d-v2", np.ones(6), 5 - 6),
        ("MO-Walker2d-v2", np.full(6, 7.0), 5 - 6),  # clipped
        ("MO-Swimmer-v2", np.ones(2), 0.3 - 0.15 * 2),
        ("MO-Hopper-v3", np.array([1.0, 2.0, 3.0]), 5 - 14),
        ("MO-Hopper-v3", np.array([9.0, -9.0, 9.0]), 5 - (4 + 4 + 16)),
    ],
)
def test_effort(name, action, effort):
    assert make(name).step(action)[1][-1] == pytest.approx(effort, abs=1e-6)


def test_hopper_is_paid_for_its_height():
    env = make("MO-Hopper-v2").unwrapped
    _, reward, *_ = env.step(np.array([0.0, 1.0, -2.0]))
    height = env.data.qpos[1] - 1.25
    assert reward[1] == pytest.approx(12 * height + 1 - 2e-4 * 5, rel=1e-5)


def test_ant_is_paid_along_both_axes():
    env = make("MO-Ant-v2").unwrapped
    velocity = env.init_qvel.copy()
    velocity[:2] = 1.0, -2.0
    env.set_state(env.init_qpos, velocity)
    _, reward, *_ = env.step(np.full(8, 0.5))
    # The same cost for both, half of 8 quarters.
    assert reward[0] > 0.5 > -1.0 > reward[1]
    assert reward.sum() == pytest.approx(
        env.data.body("torso").xpos[:2].sum() / 0.05 + 2 * (1 - 1.0), rel=0.1
    )


def test_speeds_beyond_ten_are_seen_as_ten():
    env = make("MO-Walker2d-v2").unwrapped
    env.set_state(env.init_qpos, np.full(9, 20.0))
    assert (env._observation()[8:] == 10).all()


@pytest.mark.parametrize("name", TASKS)
def test_every_episode_starts_alike(name):
    env = make(name)
    first, _ = env.reset(seed=1)
    again, _ = env.reset(seed=2)
    np.testing.assert_array_equal(first, again)
    noisy = make(name, reset_noise=0.01)
    one, _ = noisy.reset(seed=1)
    other, _ = noisy.reset(seed=2)
    assert 0 < np.abs(one - other).max() <= 0.02 + 1e-6


@pytest.mark.parametrize(
    ("name", "index", "value"),
    [
        ("MO-HalfCheetah-v2", 2, 1.0),
        ("MO-Walker2d-v2", 2, 1.2),
        ("MO-Walker2d-v2", 1, 0.5),
        ("MO-Hopper-v2", 2, 1.8),
        ("MO-Hopper-v2", 1, 0.2),
    ],
)
def test_who_has_fallen_is_out(name, index, value):
    env = make(name).unwrapped
    assert not env.step(np.zeros(env.action_space.shape))[2]
    position = env.init_qpos.copy()
    position[index] = value
    env.set_state(position, env.init_qvel)
    assert env.step(np.zeros(env.action_space.shape))[2]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"reset_noise": -0.1}, "reset_noise must not be negative, got -0.1"),
        ({"num_objectives": 4}, "num_objectives must be 2 or 3, got 4"),
    ],
)
def test_mistakes(arguments, message):
    with pytest.raises(ValueError, match=message):
        pgmorl.MOHopper(**arguments)
