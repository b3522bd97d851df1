"""Metrics in closed form, rollouts over preferences, and what the plots draw."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from matplotlib import colormaps
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.envs import TransformedEnv
from torchrl.modules import AdditiveGaussianModule

from torchrl_morl import PreferenceSpace
from torchrl_morl.evaluation import (
    PREFERENCE_COLORS,
    draw_paths,
    draw_scene,
    episode_mask,
    min_human_distance,
    path_length,
    rollout_preferences,
    steerability,
    time_to_goal,
)
from torchrl_morl.testing import VectorRewardMockEnv
from torchrl_morl.transforms import PreferenceSampler

SPACE = PreferenceSpace(("distance", "efficiency"))


def straight(points: int = 11, step: float = 0.5) -> torch.Tensor:
    """Along the x axis from the origin."""
    x = step * torch.arange(points, dtype=torch.float64)
    return torch.stack((x, torch.zeros_like(x)), dim=-1)


def circle(radius: float, points: int = 361) -> torch.Tensor:
    """Once around the origin."""
    angle = torch.linspace(0, 2 * math.pi, points, dtype=torch.float64)
    return radius * torch.stack((angle.cos(), angle.sin()), dim=-1)


def whole(path: torch.Tensor) -> torch.Tensor:
    return torch.ones(path.shape[:-1], dtype=torch.bool)


# --- metrics


def test_straight_line():
    path = straight()
    human = torch.tensor([2.0, 1.5], dtype=torch.float64).expand_as(path)
    assert path_length(path, whole(path)).item() == 5.0
    assert min_human_distance(path, human, whole(path)).item() == 1.5
    assert time_to_goal(torch.tensor(True), whole(path), dt=0.2).item() == pytest.approx(2.0)


def test_circle():
    path = circle(3.0)
    chord = 2 * 3.0 * math.sin(math.pi / 360)
    assert path_length(path, whole(path)).item() == pytest.approx(360 * chord)
    assert path_length(path, whole(path)).item() == pytest.approx(6 * math.pi, rel=1e-4)
    centre, outside = torch.zeros_like(path), torch.zeros_like(path)
    outside[..., 1] = 5.0
    assert min_human_distance(path, centre, whole(path)).item() == pytest.approx(3.0)
    assert min_human_distance(path, outside, whole(path)).item() == pytest.approx(2.0)


def test_standing_robot_and_a_human_who_passes():
    path = torch.zeros(11, 2, dtype=torch.float64)
    human = straight() - torch.tensor([2.5, -0.75])
    assert path_length(path, whole(path)).item() == 0.0
    assert min_human_distance(path, human, whole(path)).item() == 0.75
    assert time_to_goal(torch.tensor(False), whole(path), dt=0.2).isnan()


def test_robot_and_human_meet_head_on():
    path, human = straight(), 5.0 - straight()
    human[:, 1] = 0.0
    distance = min_human_distance(path, human, whole(path))
    assert distance.item() == 0.0


@pytest.mark.parametrize("padding", [0.0, 100.0, torch.nan])
def test_padding_does_not_count(padding):
    path = torch.cat((straight(5), torch.full((4, 2), padding, dtype=torch.float64)))
    human = torch.tensor([2.0, 3.0], dtype=torch.float64).repeat(9, 1)
    human[5:] = padding
    mask = torch.arange(9) < 5
    assert path_length(path, mask).item() == 2.0
    assert min_human_distance(path, human, mask).item() == 3.0
    assert time_to_goal(torch.tensor(True), mask, dt=0.5).item() == 2.0


def test_undefined_is_nan():
    path, mask = straight(), torch.zeros(11, dtype=torch.bool)
    assert path_length(path, mask).isnan()
    assert min_human_distance(path, path, mask).isnan()
    assert time_to_goal(torch.tensor(False), whole(path), dt=0.2).isnan()
    assert time_to_goal(torch.tensor(True), mask, dt=0.2).isnan()


def test_any_batch_shape():
    generator = torch.Generator().manual_seed(0)
    path, human = torch.rand(2, 3, 2, 7, 2, generator=generator).unbind(2)
    mask = torch.arange(7) < torch.tensor([[7, 3, 1], [2, 4, 5]]).unsqueeze(-1)
    success = torch.tensor([[True, False, True], [False, True, True]])
    length, nearest = path_length(path, mask), min_human_distance(path, human, mask)
    time = time_to_goal(success, mask, dt=0.5)
    for i in range(2):
        for j in range(3):
            count = int(mask[i, j].sum())
            points, others = path[i, j, :count].numpy(), human[i, j, :count].numpy()
            steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
            assert length[i, j].item() == pytest.approx(steps.sum(), abs=1e-6)
            apart = np.linalg.norm(points - others, axis=1)
            assert nearest[i, j].item() == pytest.approx(apart.min(), abs=1e-6)
            expected = 0.5 * (count - 1) if success[i, j] else math.nan
            assert time[i, j].item() == pytest.approx(expected, nan_ok=True)


@pytest.mark.parametrize(
    ("metric", "rho"),
    [
        ([0.1, 0.2, 5.0, 9.0], 1.0),  # ranks count, not values
        ([9.0, 5.0, 0.2, 0.1], -1.0),
        ([1.0, 2.0, 4.0, 3.0], 0.8),  # 1 - 6 * (1 + 1) / (4 * (16 - 1))
    ],
)
def test_steerability_is_a_rank_correlation(metric, rho):
    preference = torch.tensor([0.0, 0.3, 0.6, 1.0])
    assert steerability(preference, torch.tensor(metric)) == pytest.approx(rho)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("metric", [[1.0, 1.0, 1.0], [1.0, math.nan, 3.0]])
def test_steerability_without_an_order_is_nan(metric):
    preference, metric = torch.tensor([0.0, 0.5, 1.0]), torch.tensor(metric)
    assert math.isnan(steerability(preference, metric))
    assert math.isnan(steerability(metric, preference))


# --- rollouts


def test_episode_mask():
    done = torch.tensor([[0, 0, 0], [0, 1, 0], [1, 0, 1], [0, 0, 1]], dtype=torch.bool)
    expected = torch.tensor([[1, 1, 1], [1, 1, 0], [1, 0, 0], [1, 1, 1]], dtype=torch.bool)
    assert torch.equal(episode_mask(done.unsqueeze(-1)), expected)
    assert torch.equal(episode_mask(done[1].unsqueeze(-1)), expected[1])
    folded = episode_mask(done.reshape(2, 2, 3, 1))
    assert torch.equal(folded, expected.reshape(2, 2, 3))


def towards_preference() -> TensorDictModule:
    """Moves by the preference: x and y of the mock environment are its two actions."""
    return TensorDictModule(
        lambda preference: 0.5 * preference, in_keys=["preference"], out_keys=["action"]
    )


def mock_env(**kwargs) -> TransformedEnv:
    return TransformedEnv(
        VectorRewardMockEnv(2, batch_size=(3,), horizon=4, **kwargs), PreferenceSampler(SPACE)
    )


def test_every_preference_sees_the_same_episodes():
    env, preferences = mock_env(seed=5), SPACE.lattice(3)
    env.rollout(3)  # the state of the environment before does not matter
    data = rollout_preferences(env, towards_preference(), preferences, max_steps=20, seed=7)
    assert data.batch_size == (4, 3, 6)
    start = data["observation"][:, :, 0]
    assert torch.equal(start, start[:1].expand_as(start))
    assert len(start[0].unique(dim=0)) == 3
    expected = preferences[:, None, None].expand(4, 3, 6, 2)
    mask = data["mask"].unsqueeze(-1)
    assert torch.equal(data["preference"] * mask, expected * mask)
    assert not torch.equal(data["observation"][0, :, 1], data["observation"][1, :, 1])

    again = rollout_preferences(env, towards_preference(), preferences, max_steps=20, seed=7)
    assert (again == data).all()
    other = rollout_preferences(env, towards_preference(), preferences, max_steps=20, seed=8)
    assert not torch.equal(other["observation"][:, :, 0], start)


def test_mask_ends_with_the_first_episode():
    # Environment i is truncated after 4 + i steps.
    data = rollout_preferences(
        mock_env(), towards_preference(), SPACE.corners(), max_steps=20, seed=0
    )
    assert data["mask"].sum(-1).tolist() == [[4, 5, 6], [4, 5, 6]]
    end = data["mask"].sum(-1, keepdim=True) - 1
    done = data["next", "done"].squeeze(-1)
    assert done.gather(-1, end).all()
    assert not (done & data["mask"]).scatter(-1, end, False).any()
    short = rollout_preferences(
        mock_env(), towards_preference(), SPACE.corners(), max_steps=3, seed=0
    )
    assert short["mask"].all()
    assert not short["next", "done"].any()


class PreferenceSetsHorizon(VectorRewardMockEnv):
    """Episodes end sooner the larger the first entry of the action is."""

    def _step(self, tensordict):
        self.horizon = torch.where(tensordict["action"][..., :1] > 0.4, 2, 5)
        return super()._step(tensordict)


def test_shorter_rollouts_are_padded():
    base = PreferenceSetsHorizon(2, batch_size=(3,), seed=0)
    env = TransformedEnv(base, PreferenceSampler(SPACE))
    data = rollout_preferences(env, towards_preference(), SPACE.corners(), max_steps=9, seed=0)
    assert data.batch_size == (2, 3, 5)
    assert data["mask"].sum(-1).tolist() == [[2] * 3, [5] * 3]
    tail = data[0, :, 2:]
    assert not tail["observation"].any() and not tail["next", "reward"].any()


def test_rollouts_do_not_explore_and_keep_no_graph():
    env = mock_env()
    actor = towards_preference()
    noise = AdditiveGaussianModule(spec=env.action_spec_unbatched, sigma_init=1.0, sigma_end=1.0)
    policy = TensorDictSequential(actor, noise)
    noisy = env.rollout(2, policy)
    assert not torch.equal(noisy["action"], 0.5 * noisy["preference"])
    data = rollout_preferences(env, policy, SPACE.lattice(2), max_steps=9, seed=0)
    assert torch.equal(data["action"], 0.5 * data["preference"])
    assert not data["next", "reward"].requires_grad


def test_nested_preference_key_and_what_is_kept():
    key = ("agent", "preference")
    env = TransformedEnv(
        VectorRewardMockEnv(2, batch_size=(3,), prefix="agent"),
        PreferenceSampler(SPACE, preference_key=key),
    )
    policy = TensorDictModule(lambda p: p, in_keys=[key], out_keys=[("agent", "action")])
    seen = []
    data = rollout_preferences(
        env,
        policy,
        SPACE.lattice(2),
        max_steps=2,
        seed=0,
        preference_key=key,
        keep=lambda rollout: rollout.select(("next", "agent", "reward")),
        on_preference=seen.append,
    )
    assert set(data.keys(True, True)) == {("next", "agent", "reward"), "mask"}
    assert seen == [0, 1, 2]


def test_environment_without_a_batch():
    env = TransformedEnv(VectorRewardMockEnv(2, horizon=4), PreferenceSampler(SPACE))
    data = rollout_preferences(env, towards_preference(), SPACE.corners(), max_steps=9, seed=0)
    assert data.batch_size == (2, 4)
    assert data["mask"].all()


def test_preferences_off_the_simplex_are_refused():
    with pytest.raises(ValueError, match=r"sums to 1\.5"):
        rollout_preferences(
            mock_env(), towards_preference(), torch.tensor([[1.0, 0.5]]), max_steps=2, seed=0
        )


@pytest.mark.parametrize("convert", [lambda p: p.tolist(), lambda p: p.double().numpy()])
def test_preferences_as_lists_and_arrays(convert):
    expected = rollout_preferences(
        mock_env(), towards_preference(), SPACE.lattice(2), max_steps=3, seed=0
    )
    data = rollout_preferences(
        mock_env(), towards_preference(), convert(SPACE.lattice(2)), max_steps=3, seed=0
    )
    assert (data == expected).all()
    corners = rollout_preferences(
        mock_env(), towards_preference(), [[1, 0], [0, 1]], max_steps=3, seed=0
    )
    assert torch.equal(corners["preference"][:, 0, 0], torch.eye(2))


@pytest.mark.parametrize("preferences", [[0.5, 0.5], [], torch.zeros(0, 2)])
def test_preferences_are_a_table(preferences):
    with pytest.raises(ValueError, match=r"^preferences must have shape \[P, T\], one a row, got"):
        rollout_preferences(mock_env(), towards_preference(), preferences, max_steps=3, seed=0)


# --- plots


@pytest.fixture
def ax():
    return Figure().subplots()  # no pyplot: nothing global, and drawn by Agg


def test_scene_holds_start_goal_human_and_boxes(ax):
    draw_scene(
        ax,
        start=torch.tensor([0.0, 0.5, 1.0]),
        goal=torch.tensor([8.0, -1.0]),
        human=torch.tensor([4.0, 0.0, math.pi]),
        boxes=torch.tensor([[2.0, 1.0, math.pi / 2, 0.6, 0.2], [6.0, 0.0, 0.0, 0.3, 0.1]]),
        human_radius=0.25,
        goal_radius=0.3,
    )
    boxes = [patch for patch in ax.patches if isinstance(patch, Polygon)]
    assert len(boxes) == 2
    # A quarter turn puts the long side of the first box along y.
    assert boxes[0].get_xy().min(0) == pytest.approx([1.8, 0.4])
    assert boxes[0].get_xy().max(0) == pytest.approx([2.2, 1.6])
    assert boxes[1].get_xy().max(0) == pytest.approx([6.3, 0.1])
    circles = {
        tuple(patch.center): patch.radius for patch in ax.patches if isinstance(patch, Circle)
    }
    assert circles == {(4.0, 0.0): 0.25, (8.0, -1.0): pytest.approx(0.3)}
    points = {line.get_marker(): line.get_xydata()[0].tolist() for line in ax.lines}
    assert points == {"*": [8.0, -1.0], "o": [0.0, 0.5]}
    (nose,) = ax.texts
    assert nose.xy == pytest.approx((4.0 - 1.9 * 0.25, 0.0), abs=1e-6)
    assert ax.get_aspect() == 1
    ax.figure.canvas.draw()


def test_box_turns_counter_clockwise(ax):
    scene = {
        "start": torch.zeros(3),
        "goal": torch.zeros(2),
        "human": torch.zeros(3),
        "human_radius": 0.25,
        "goal_radius": 0.3,
    }
    draw_scene(ax, boxes=torch.tensor([[0.0, 0.0, math.pi / 6, 2.0, 0.0]]), **scene)
    (box,) = (patch for patch in ax.patches if isinstance(patch, Polygon))
    end = (2 * math.cos(math.pi / 6), 2 * math.sin(math.pi / 6))
    assert box.get_xy()[0] == pytest.approx(end)


def test_paths_end_with_their_mask_and_have_the_colour_of_their_value(ax):
    position = torch.stack((straight(6), circle(2.0, 6)))
    mask = torch.tensor([[True] * 6, [True] * 4 + [False] * 2])
    draw_paths(ax, position, mask, torch.tensor([0.0, 0.75]), linewidth=3.0)
    assert len(ax.lines) == 2
    assert np.allclose(ax.lines[0].get_xydata(), position[0])
    assert np.allclose(ax.lines[1].get_xydata(), position[1, :4])
    for line, value in zip(ax.lines, (0.0, 0.75), strict=True):
        assert to_hex(line.get_color()) == to_hex(colormaps[PREFERENCE_COLORS](value))
        assert line.get_linewidth() == 3.0
    ax.figure.canvas.draw()


def test_every_path_needs_its_value(ax):
    with pytest.raises(ValueError, match="zip"):
        draw_paths(ax, torch.zeros(2, 3, 2), torch.ones(2, 3).bool(), torch.zeros(3))
