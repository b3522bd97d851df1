"""The order of scenes: those of the seed, and the failed ones again."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest
import torch
from torchrl.envs.utils import check_env_specs

from envs import NavigationEnv
from envs.scene_files import get_scene
from envs.scene_stream import SceneStream

ROWS = np.arange(4)
NONE = np.zeros(4, dtype=bool)


def _stream(share: float) -> tuple[SceneStream, torch.Generator]:
    stream = SceneStream(get_scene("static"), 0.2, 4, repeat_failed=share)
    stream.seed(3)
    return stream, torch.Generator().manual_seed(0)


def _names(scenes: dict[str, np.ndarray]) -> list[float]:
    """A number by which a scene is known again."""
    return scenes["goal"][:, 0].tolist()


def test_without_failures_the_scenes_are_those_of_the_seed():
    (plain, first), (repeating, second) = _stream(0.0), _stream(1.0)
    for _ in range(40):  # more than a block
        expected, dealt = plain.deal(ROWS, NONE, first), repeating.deal(ROWS, NONE, second)
        for key, values in expected.items():
            np.testing.assert_array_equal(dealt[key], values)


def test_failed_scenes_and_only_those_come_again():
    stream, generator = _stream(1.0)
    start = stream.deal(ROWS, NONE, generator)
    again = stream.deal(ROWS, np.array([False, True, False, True]), generator)
    for place in range(4):
        same = [index for index in range(4) if _names(start)[index] == _names(again)[place]]
        assert same and same[0] in (1, 3)
        # The whole scene comes again, not only its goal.
        for key, values in start.items():
            np.testing.assert_array_equal(again[key][place], values[same[0]])
    # In some of the environments only, which need not be the ones that failed.
    some = stream.deal(np.array([2]), np.array([False]), generator)
    assert _names(some)[0] in (_names(start)[1], _names(start)[3])


def test_new_scenes_keep_their_order_between_repeated_ones():
    (plain, first), (repeating, second) = _stream(0.0), _stream(0.5)
    new = [name for _ in range(60) for name in _names(plain.deal(ROWS, NONE, first))]
    repeating.deal(ROWS, NONE, second)
    failed, dealt = np.array([True, False, False, False]), []
    for _ in range(50):
        dealt += _names(repeating.deal(ROWS, failed, second))
    fresh = [name for index, name in enumerate(dealt) if name not in (*new[:4], *dealt[:index])]
    assert fresh == new[4 : 4 + len(fresh)]
    # Half of 200, within four standard deviations.
    assert 100 - 4 * 50**0.5 < len(fresh) < 100 + 4 * 50**0.5


@pytest.mark.parametrize("share", [-0.1, 1.5])
def test_a_share_is_between_0_and_1(share):
    with pytest.raises(ValueError, match=rf"repeat_failed must be between 0 and 1, got {share}"):
        NavigationEnv(repeat_failed=share)


def test_an_environment_repeats_the_scenes_in_which_it_failed():
    env = NavigationEnv(num_envs=3, seed=0, repeat_failed=1.0, max_episode_steps=2)
    check_env_specs(NavigationEnv(num_envs=3, seed=0, repeat_failed=1.0))
    # Nobody arrives within two steps: from the second episode on nothing is new.
    goals = env.rollout(8, break_when_any_done=False)["scene", "goal"][..., 0]
    episodes = goals[:, ::2]
    assert set(episodes[:, 1:].flatten().tolist()) <= set(episodes[:, 0].tolist())
    # A reset in the middle of an episode is no failure.
    env = NavigationEnv(num_envs=3, seed=0, repeat_failed=1.0)
    first, second = env.reset(), env.reset()
    assert not torch.isin(second["scene", "goal"][:, 0], first["scene", "goal"][:, 0]).any()


def test_success_is_no_failure():
    env = NavigationEnv(num_envs=2, seed=0, scene="empty", repeat_failed=1.0)
    data = env.reset()
    # Put before their goals, they arrive at once.
    data["qpos"][:, :2] = data["scene", "goal"] - torch.tensor([0.35, 0.0])
    data["qpos"][:, 2] = 0.0
    data = env.reset(data, set_state=True)
    ahead = torch.tensor([[0.5, 0.0]]).expand(2, 2)
    step = env.step(data.set("action", ahead))["next"]
    assert step["success"].all()
    later = env.reset()
    assert not torch.isin(later["scene", "goal"][:, 0], data["scene", "goal"][:, 0]).any()


def test_a_restored_snapshot_is_not_the_scene_that_was_dealt():
    env = NavigationEnv(num_envs=2, seed=0, repeat_failed=1.0, max_episode_steps=1)
    first = env.reset()
    env.reset(first, set_state=True)
    env.step(env.rand_action(first.clone()))  # and ends without success
    later = env.reset()
    assert not torch.isin(later["scene", "goal"][:, 0], first["scene", "goal"][:, 0]).any()


def test_a_seed_fixes_what_comes_again():
    def goals(env: NavigationEnv) -> torch.Tensor:
        return env.rollout(12, break_when_any_done=False)["scene", "goal"]

    arguments = {"num_envs": 3, "repeat_failed": 0.5, "max_episode_steps": 2}
    env = NavigationEnv(seed=1, **arguments)
    expected = goals(env)
    assert torch.equal(goals(NavigationEnv(seed=1, **arguments)), expected)
    env.set_seed(1)
    env.reset()
    env.set_seed(1)
    assert torch.equal(goals(env), expected)


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda one: pickle.loads(pickle.dumps(one))])
def test_copies_go_on_alike(copied):
    stream, generator = _stream(0.5)
    stream.deal(ROWS, NONE, generator)
    stream.deal(ROWS, np.array([True, True, False, False]), generator)
    other = copied(stream)
    state = generator.get_state()
    names = [_names(stream.deal(ROWS, NONE, generator)) for _ in range(5)]
    generator.set_state(state)
    assert [_names(other.deal(ROWS, NONE, generator)) for _ in range(5)] == names
