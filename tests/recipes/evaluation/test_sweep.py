"""Sweeps over preferences: the same scenes for all of them, their table, and their edges."""

from __future__ import annotations

import pytest
import torch

from envs import Faults, NavigationEnv
from envs.demonstrations import CircleDemonstrator
from recipes.evaluation.sweep import edge, sweep
from tests._sweeps import BEND, DEMO_SPACE, SPACE

STEPS = {"max_episode_steps": 100, "num_threads": 1}


@pytest.fixture(scope="module")
def swept():
    preferences = edge(SPACE, "efficiency", "distance", 3)
    return sweep(BEND, SPACE, preferences, episodes=20, seed=5, **STEPS)


def test_every_preference_meets_the_same_scenes(swept):
    assert swept.metrics.shape == swept.paths.shape == (3, 20)
    assert swept.scenes.shape == (20,)
    for row in range(3):
        start = swept.paths[row]
        assert torch.equal(start["position"][:, 0], swept.scenes["start"][:, :2])
        assert torch.equal(start["human"][:, 0], swept.scenes["human"][:, :2])
        distance = swept.scenes["goal"].norm(dim=-1).float()
        torch.testing.assert_close(swept.metrics["direct_distance"][row], distance)
    assert swept.scenes["goal"].unique(dim=0).shape == (20, 2)
    assert not torch.equal(swept.paths["position"][0], swept.paths["position"][2])
    again = sweep(BEND, SPACE, swept.preferences[2:], episodes=20, seed=5, **STEPS)
    for name in ("time", "min_human_distance", "path_length"):
        torch.testing.assert_close(
            again.metrics[name][0], swept.metrics[name][2], rtol=0, atol=0, equal_nan=True
        )


def test_scenes_hold_what_a_picture_needs(swept):
    env = NavigationEnv(num_envs=20, seed=5, num_threads=1)
    start = env.reset()
    env.close()
    for name, key in (
        ("start", "pose"),
        ("human", "human_pose"),
        ("goal", ("scene", "goal")),
        ("boxes", ("scene", "boxes")),
    ):
        assert torch.equal(swept.scenes[name], start[key])


def test_table_has_a_row_per_preference(swept):
    header, *rows = swept.table().splitlines()
    assert header.split()[:2] == ["distance", "efficiency"]
    assert "Frechet" not in header
    assert swept.demonstration is None
    assert "frechet" not in swept.metrics.keys()
    weights = [tuple(map(float, row.split()[:2])) for row in rows]
    assert weights == [(0.0, 1.0), (0.5, 0.5), (1.0, 0.0)]
    for row, solved in zip(rows, swept.metrics["success"].sum(-1).tolist(), strict=True):
        assert f"{'s' if solved else '-'} ({solved})" in row
        assert "m (20)" in row


@pytest.fixture(scope="module")
def demonstrated():
    """The demonstrator itself, as a policy that does not care for preferences."""
    return sweep(
        CircleDemonstrator(scaled=True),
        DEMO_SPACE,
        edge(DEMO_SPACE, "efficiency", "demo", 2),
        episodes=30,
        seed=3,
        demonstrator=CircleDemonstrator(),
        num_threads=1,
    )


def test_the_demonstrator_follows_its_demonstration(demonstrated):
    free, frechet = demonstrated.demonstration["free"], demonstrated.metrics["frechet"]
    assert 3 < free.sum() < 30
    assert frechet[:, free].max() < 1e-3
    assert demonstrated.metrics["success"][:, free].all()
    # Where a box is in its way it hits it, and the rest of the demonstration is missing.
    assert demonstrated.metrics["collision_obstacle"][:, ~free].all()
    assert (frechet[:, ~free] > 0.3).all()


def test_table_with_a_demonstrator_has_the_distance_to_it(demonstrated):
    header, *rows = demonstrated.table().splitlines()
    assert header.split()[:3] == ["demo", "distance", "efficiency"]
    free = int(demonstrated.demonstration["free"].sum())
    assert "Frechet, free (n)" in header and "all (n)" in header
    assert len(rows) == 2
    for row in rows:
        assert f"  0.00 m ({free})" in row
        assert row.endswith(f"{demonstrated.metrics['frechet'][0].mean():.2f} m (30)")


def test_faults_of_the_robot_do_not_change_what_it_was_shown(demonstrated):
    faulty = sweep(
        CircleDemonstrator(scaled=True),
        DEMO_SPACE,
        demonstrated.preferences[:1],
        episodes=4,
        seed=3,
        demonstrator=CircleDemonstrator(),
        faults=Faults(velocity_noise=0.2, latency=1),
        num_threads=1,
    )
    shown, before = faulty.demonstration, demonstrated.demonstration[:4]
    for row in range(4):
        path = shown["position"][row][shown["mask"][row]]
        assert torch.equal(path, before["position"][row][before["mask"][row]])
    assert (faulty.metrics["frechet"] > 1e-3).all()


def test_sweep_tells_its_progress_and_refuses_what_is_no_preference():
    done = []
    sweep(
        BEND,
        SPACE,
        edge(SPACE, "distance", "efficiency", 2),
        episodes=1,
        seed=0,
        max_episode_steps=3,
        num_threads=1,
        on_preference=done.append,
    )
    assert done == [0, 1]
    with pytest.raises(ValueError, match="preference"):
        sweep(BEND, SPACE, torch.tensor([[0.5, 0.6]]), episodes=1, seed=0)


def test_edge():
    expected = torch.tensor([[0.0, 0.0, 1.0], [0.5, 0.0, 0.5], [1.0, 0.0, 0.0]])
    assert torch.equal(edge(DEMO_SPACE, "efficiency", "demo", 3), expected)
    assert edge(SPACE, "efficiency", "distance").shape == (11, 2)


@pytest.mark.parametrize(("first", "second"), [("core", "distance"), ("distance", "comfort")])
def test_edge_between_what_is_not_tunable(first, second):
    with pytest.raises(ValueError, match=r"'(core|comfort)' is not tunable: choose among"):
        edge(SPACE, first, second)
