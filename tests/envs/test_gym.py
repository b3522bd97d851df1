"""The Gymnasium face: MO-Gymnasium's conventions and wrappers, seeding, and TorchRL's own wrapper."""

from __future__ import annotations

import math
import warnings

import gymnasium
import mo_gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import HumanRendering, RecordVideo, RescaleAction
from mo_gymnasium.wrappers import LinearReward, MONormalizeReward, MORecordEpisodeStatistics
from mo_gymnasium.wrappers.vector import MOSyncVectorEnv
from tensordict import TensorDict
from torchrl.envs import MOGymEnv, MOGymWrapper, TransformedEnv
from torchrl.envs.utils import check_env_specs

from envs import NavigationEnv
from envs.gym import NavigationGymEnv
from torchrl_morl.deploy import save_reward_model
from torchrl_morl.deploy.features import policy_transforms
from torchrl_morl.modules import RewardModel

IDS = {
    "torchrl_morl/Navigation-v0": "static",
    "torchrl_morl/Navigation-MovingHuman-v0": "moving_human",
    "torchrl_morl/Navigation-Corridor-v0": "corridor",
}
AHEAD = np.array([0.5, 0.0], dtype=np.float32)


class Scalar(gymnasium.RewardWrapper, gymnasium.utils.RecordConstructorArgs):
    """What check_env needs: one number. (LinearReward puts its own weights into every info.)"""

    def __init__(self, env):
        gymnasium.utils.RecordConstructorArgs.__init__(self)
        gymnasium.RewardWrapper.__init__(self, env)

    def reward(self, reward):
        return float(reward.sum())


@pytest.mark.parametrize("name", IDS)
def test_ids_name_the_scenes(name):
    env = mo_gymnasium.make(name)
    assert isinstance(env.unwrapped, NavigationGymEnv)
    assert env.spec.id == name
    observation, info = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    assert info == {"success": False, "collision_human": False, "collision_obstacle": False}
    assert env.unwrapped._navigation.scene.name == IDS[name]


def test_keywords_reach_the_simulation():
    env = mo_gymnasium.make("torchrl_morl/Navigation-v0", scene="empty", robot="hsr")
    assert env.unwrapped._navigation.scene.name == "empty"
    assert env.unwrapped._navigation.robot.name == "hsr"
    with pytest.raises(ValueError, match="Unknown scene 'maze'"):
        mo_gymnasium.make("torchrl_morl/Navigation-v0", scene="maze")


def test_a_reward_model_adds_the_objective_demo(tmp_path):
    model = RewardModel(in_features=36 + 2, num_cells=(8,))
    save_reward_model(tmp_path, model, card={})
    env = mo_gymnasium.make("torchrl_morl/Navigation-v0", reward_model=str(tmp_path))
    assert env.unwrapped.objectives == ("core", "demo", "distance", "efficiency")
    assert env.unwrapped.reward_dim == 4 and env.unwrapped.reward_space.shape == (4,)
    observation, _ = env.reset(seed=0)
    # Full speed and a quarter of a turn to the left are (1, 0.5) for a policy; faster is no faster.
    _, reward, *_ = env.step(np.array([0.7, math.pi / 2], dtype=np.float32))
    step = TensorDict(observation=torch.from_numpy(observation), action=torch.tensor([1.0, 0.5]))
    score = model(step)["demo_score"].item()
    assert reward[1] == pytest.approx(10 * (score - 1), abs=1e-5)
    bare = mo_gymnasium.make("torchrl_morl/Navigation-v0")
    bare.reset(seed=0)
    _, without, *_ = bare.step(np.array([0.7, math.pi / 2], dtype=np.float32))
    np.testing.assert_array_equal(reward[[0, 2, 3]], without)
    blind = RewardModel(in_features=33 + 2, num_cells=(8,))
    with pytest.raises(ValueError, match="observations of 33 entries, here they have 36"):
        mo_gymnasium.make("torchrl_morl/Navigation-v0", reward_model=blind)
    with pytest.raises(FileNotFoundError, match="reward_model"):
        mo_gymnasium.make("torchrl_morl/Navigation-v0", reward_model=str(tmp_path / "none"))


@pytest.mark.parametrize("name", IDS)
def test_gymnasium_s_checker_is_satisfied(name):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(Scalar(mo_gymnasium.make(name).unwrapped), skip_render_check=True)
    # Advice that does not apply: distances are unbounded, and actions are in m/s and rad/s. The
    # wrapper itself is the other thing the checker remarks upon.
    advice = ("minimum value is -infinity", "maximum value is infinity", "symmetric and normalized")
    advice += ("is different from the unwrapped version",)
    remarks = [str(warning.message) for warning in caught]
    assert not [remark for remark in remarks if not any(known in remark for known in advice)]


def test_steps_follow_mo_gymnasium():
    env = mo_gymnasium.make("torchrl_morl/Navigation-v0")
    env.reset(seed=1)
    observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
    bare = env.unwrapped
    assert bare.reward_dim == 3 and bare.objectives == ("core", "distance", "efficiency")
    assert bare.reward_space.shape == (3,) and bare.reward_space.contains(reward)
    assert reward.dtype == observation.dtype == np.float32 and reward[2] == -10.0
    assert type(terminated) is type(truncated) is bool
    assert all(type(value) is bool for value in info.values())


def test_it_is_the_simulation_that_the_policy_sees():
    env = NavigationGymEnv(scene="moving_human")
    observation, _ = env.reset(seed=11)
    seed = int(np.random.default_rng(11).integers(2**31))
    twin = TransformedEnv(
        NavigationEnv(num_envs=1, num_threads=1, scene="moving_human", seed=seed),
        policy_transforms(),
    )
    current = twin.reset()
    np.testing.assert_array_equal(observation, current["observation"][0].numpy())
    for _ in range(40):
        action = env.action_space.sample()
        observation, reward, terminated, *_ = env.step(action)
        normed = torch.from_numpy(action / [0.25, math.pi] - [1.0, 0.0]).float()
        current = twin.step(current.set("action", normed[None]))["next"]
        np.testing.assert_allclose(observation, current["observation"][0], rtol=0, atol=1e-5)
        np.testing.assert_allclose(reward, current["reward"][0], rtol=0, atol=1e-3)
        assert terminated == bool(current["terminated"])


def test_seeds_follow_gymnasium():
    env, twin, other = (NavigationGymEnv() for _ in range(3))
    first, _ = env.reset(seed=5)
    np.testing.assert_array_equal(first, twin.reset(seed=5)[0])
    assert not np.array_equal(first, other.reset(seed=6)[0])
    # Without a seed the stream goes on: new scenes, the same in both.
    second, _ = env.reset()
    assert not np.array_equal(first, second)
    np.testing.assert_array_equal(second, twin.reset()[0])
    np.testing.assert_array_equal(first, env.reset(seed=5)[0])
    unseeded = [NavigationGymEnv().reset()[0] for _ in range(2)]
    assert not np.array_equal(*unseeded)


def test_actions_are_clamped_to_the_robot_s_limits():
    env, twin = NavigationGymEnv(), NavigationGymEnv()
    assert env.action_space.low.tolist() == [0.0, np.float32(-math.pi)]
    assert env.action_space.high.tolist() == [0.5, np.float32(math.pi)]
    for each in (env, twin):
        each.reset(seed=0)
    np.testing.assert_array_equal(env.step(np.array([9.0, -9.0]))[0], twin.step([0.5, -math.pi])[0])


def test_misuse_is_explained():
    env = NavigationGymEnv()
    with pytest.raises(RuntimeError, match="Call reset before the first step"):
        env.step(AHEAD)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"An action is \(2,\), got \(3,\)"):
        env.step(np.zeros(3))
    with pytest.raises(ValueError, match="must be finite"):
        env.step(np.array([np.nan, 0.0]))
    with pytest.raises(ValueError, match="render_mode must be 'rgb_array' or None, got 'human'"):
        NavigationGymEnv(render_mode="human")


def test_termination_and_truncation_are_told_apart():
    env = NavigationGymEnv(max_episode_steps=4)
    env.reset(seed=0)
    flags = [env.step(np.zeros(2))[2:4] for _ in range(4)]
    assert flags == [(False, False)] * 3 + [(False, True)]
    env = NavigationGymEnv(scene="showcase")  # straight ahead stands the human
    env.reset(seed=0)
    for _ in range(60):
        _, reward, terminated, truncated, info = env.step(AHEAD)
        if terminated or truncated:
            break
    assert terminated and not truncated and reward[0] < -900
    assert info == {"success": False, "collision_human": True, "collision_obstacle": False}


def steps_until_truncated(env, limit: int) -> int:
    env.reset(seed=0)
    for step in range(1, limit + 1):
        _, _, terminated, truncated, _ = env.step(np.zeros(2, dtype=np.float32))
        assert not terminated
        if truncated:
            return step
    return 0


@pytest.mark.parametrize(("limit", "steps"), [(None, 300), (5, 5), (340, 340), (-1, 0)])
def test_the_limit_of_make_is_the_limit(limit, steps):
    limits = {} if limit is None else {"max_episode_steps": limit}
    env = mo_gymnasium.make("torchrl_morl/Navigation-v0", scene="empty", **limits)
    assert steps_until_truncated(env, 350) == steps
    if limit != -1:
        assert env.spec.max_episode_steps == steps


def test_the_limit_of_the_class():
    assert steps_until_truncated(NavigationGymEnv(scene="empty"), 350) == 300
    assert steps_until_truncated(NavigationGymEnv(scene="empty", max_episode_steps=7), 350) == 7


def test_what_is_observed_of_the_human():
    name = "torchrl_morl/Navigation-MovingHuman-v0"
    env = mo_gymnasium.make(name, observe_human_velocity=True)
    plain, blind = mo_gymnasium.make(name), mo_gymnasium.make(name, observe_human=False)
    seen = [x.reset(seed=3)[0] for x in (env, plain, blind)]
    assert [x.observation_space.shape for x in (env, plain, blind)] == [(38,), (36,), (33,)]
    assert seen[0][36:].tolist() == [0.0, 0.0]
    before = env.unwrapped._current["human_pose"][0, :2]
    for _ in range(3):
        seen = [x.step(AHEAD)[0] for x in (env, plain, blind)]
    np.testing.assert_array_equal(seen[0][:36], seen[1])
    np.testing.assert_array_equal(seen[1][:33], seen[2])
    walked = (env.unwrapped._current["human_pose"][0, :2] - before).norm() / 0.6
    assert np.linalg.norm(seen[0][36:]) == pytest.approx(walked.item(), abs=0.05)
    assert walked > 0.3
    check_env(Scalar(env.unwrapped), skip_render_check=True)
    with pytest.raises(ValueError, match="observe_human_velocity needs observe_human"):
        mo_gymnasium.make(name, observe_human=False, observe_human_velocity=True)


def test_a_window_is_not_recorded_and_says_so(tmp_path):
    with pytest.raises(ValueError, match=r"for a window wrap .*HumanRendering"):
        NavigationGymEnv(render_mode="human")
    options = {"width": 64, "height": 48}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        window = mo_gymnasium.make("torchrl_morl/Navigation-v0", render_mode="human", **options)
    with pytest.raises(
        ValueError, match=r"human, which is incompatible with RecordVideo.*rgb_array"
    ):
        RecordVideo(window, str(tmp_path))


def test_a_window_that_is_recorded(tmp_path):
    pytest.importorskip("moviepy", reason="what Gymnasium records with")
    env = mo_gymnasium.make(
        "torchrl_morl/Navigation-v0", render_mode="rgb_array", width=64, height=48
    )
    env.reset(seed=0)
    try:
        env.render()
    except RuntimeError as error:
        if "OpenGL" not in str(error):
            raise
        pytest.skip(str(error))  # a machine that cannot draw
    env = HumanRendering(RecordVideo(env, str(tmp_path), episode_trigger=lambda episode: True))
    env.reset(seed=0)
    for _ in range(3):
        env.step(AHEAD)
    env.close()
    assert [path.suffix for path in tmp_path.iterdir()] == [".mp4"]


def test_rendering():
    env = mo_gymnasium.make(
        "torchrl_morl/Navigation-v0", render_mode="rgb_array", width=64, height=48
    )
    env.reset(seed=0)
    try:
        frame = env.render()
    except RuntimeError as error:
        if "OpenGL" not in str(error):
            raise
        pytest.skip(str(error))  # a machine that cannot draw
    assert frame.shape == (48, 64, 3) and frame.dtype == np.uint8 and frame.std() > 1
    assert NavigationGymEnv().render() is None


# --- wrappers ----------------------------------------------------------------------------------


def _returns(env, steps=6):
    env.reset(seed=0)
    return [env.step(AHEAD) for _ in range(steps)]


def test_linear_reward():
    weight = np.array([1.0, 0.25, 0.75])
    plain = _returns(mo_gymnasium.make("torchrl_morl/Navigation-v0"))
    scalar = _returns(LinearReward(mo_gymnasium.make("torchrl_morl/Navigation-v0"), weight=weight))
    for vector_step, scalar_step in zip(plain, scalar):
        assert scalar_step[1] == pytest.approx(vector_step[1] @ weight)
        np.testing.assert_array_equal(scalar_step[4]["vector_reward"], vector_step[1])


def test_normalised_reward_changes_only_its_objective():
    plain = _returns(mo_gymnasium.make("torchrl_morl/Navigation-v0"))
    env = MONormalizeReward(mo_gymnasium.make("torchrl_morl/Navigation-v0"), idx=2)
    for before, after in zip(plain, _returns(env)):
        np.testing.assert_array_equal(before[1][:2], after[1][:2])
        assert before[1][2] == -10.0 and after[1][2] < 0 and after[1][2] != -10.0


def test_episode_statistics():
    env = MORecordEpisodeStatistics(NavigationGymEnv(max_episode_steps=6), gamma=0.9)
    steps = _returns(env)
    rewards = np.stack([step[1] for step in steps])
    episode = steps[-1][4]["episode"]
    np.testing.assert_allclose(episode["r"], rewards.sum(0), rtol=1e-6)
    np.testing.assert_allclose(episode["dr"], 0.9 ** np.arange(6) @ rewards, rtol=1e-6)
    assert episode["l"] == 6


def test_vector_environments():
    def make():
        return mo_gymnasium.make("torchrl_morl/Navigation-v0", max_episode_steps=3)

    vector = MOSyncVectorEnv([make, make])
    observations, _ = vector.reset(seed=[0, 1])
    assert observations.shape == (2, 36)
    alone = make()
    alone.reset(seed=1)
    for step in range(3):
        observations, rewards, terminated, truncated, infos = vector.step(np.stack((AHEAD, AHEAD)))
        observation, reward, *_ = alone.step(AHEAD)
        np.testing.assert_array_equal(observations[1], observation)
        np.testing.assert_array_equal(rewards[1], reward)
        assert rewards.shape == (2, 3) and truncated.tolist() == [step == 2] * 2
        assert not terminated.any() and infos["success"].tolist() == [False, False]
    vector.close()


def test_rescaled_actions_are_those_of_the_policy():
    env = RescaleAction(mo_gymnasium.make("torchrl_morl/Navigation-v0"), -1.0, 1.0)
    plain = mo_gymnasium.make("torchrl_morl/Navigation-v0")
    assert env.action_space.low.tolist() == [-1.0, -1.0]
    env.reset(seed=0), plain.reset(seed=0)
    scaled = env.step(np.array([0.0, 0.5], dtype=np.float32))
    direct = plain.step(np.array([0.25, math.pi / 2], dtype=np.float32))
    np.testing.assert_allclose(scaled[0], direct[0], rtol=0, atol=1e-5)


class _GoalSeeker:
    """An agent with the interface of morl-baselines: turns towards the goal and drives."""

    gamma = 0.99

    def eval(self, obs, w):
        assert obs.shape == (36,) and w.shape == (3,)
        bearing = math.atan2(obs[31], obs[32])
        return np.array(
            [0.5 * max(math.cos(bearing), 0.0), np.clip(2 * bearing, -math.pi, math.pi)]
        )


@pytest.mark.parametrize("name", IDS)
def test_the_evaluation_loop_of_morl_baselines(name):
    agent, weight = _GoalSeeker(), np.array([0.5, 0.2, 0.3])
    env = MORecordEpisodeStatistics(mo_gymnasium.make(name), gamma=agent.gamma)
    obs, _ = env.reset(seed=0)
    done, gamma = False, 1.0
    vec_return, disc_vec_return = np.zeros_like(weight), np.zeros_like(weight)
    while not done:
        obs, reward, terminated, truncated, info = env.step(agent.eval(obs, weight))
        done = terminated or truncated
        vec_return += reward
        disc_vec_return += gamma * reward
        gamma *= agent.gamma
    length = info["episode"]["l"]
    assert 0 < length <= 300 and (length == 300 if truncated else True)
    np.testing.assert_allclose(info["episode"]["r"], vec_return, rtol=1e-4)
    np.testing.assert_allclose(info["episode"]["dr"], disc_vec_return, rtol=1e-4)
    assert vec_return[2] == -10.0 * length and vec_return[1] <= 0
    assert terminated == any(
        info[key] for key in ("success", "collision_human", "collision_obstacle")
    )


@pytest.mark.parametrize("wrapper", ["name", "object"])
def test_torchrl_wraps_it(wrapper):
    name = "torchrl_morl/Navigation-v0"
    env = MOGymEnv(name) if wrapper == "name" else MOGymWrapper(mo_gymnasium.make(name))
    check_env_specs(env)
    assert env.reward_spec.shape == (3,)
    rollout = env.rollout(5)
    assert rollout["next", "reward"].shape == (5, 3)
    assert (rollout["next", "reward"][:, 2] == -10.0).all()
