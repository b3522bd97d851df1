"""Pictures and films of sweeps and of a change of preference."""

from __future__ import annotations

import imageio.v2 as imageio
import pytest

from envs.demonstrations import CircleDemonstrator
from recipes.demo import figures
from recipes.demo.figures import Row, sweep_figure, switch_figure
from recipes.demo.film import film
from recipes.demo.switch import switch
from recipes.evaluation.sweep import edge, sweep
from tests._sweeps import BEND, DEMO_SPACE, SPACE, is_png, needs_gl
from torchrl_morl import PreferenceSpace


def row(preference_space: PreferenceSpace, first: str, second: str, demonstrator=None) -> Row:
    kwargs = {"demonstrator": demonstrator, "num_threads": 1, "max_episode_steps": 120}
    results = [
        sweep(
            CircleDemonstrator(scaled=True),
            preference_space,
            edge(preference_space, first, second, 2),
            episodes=episodes,
            seed=3,
            scene=scene,
            **kwargs,
        )
        for episodes, scene in ((1, "showcase"), (4, "static"))
    ]
    return Row(first, second, *results)


def test_sweep_figure_of_two_objectives(tmp_path):
    path = tmp_path / "sweep.png"
    sweep_figure(path, [row(SPACE, "efficiency", "distance")], goal_radius=0.3)
    assert is_png(path)


def test_sweep_figure_of_three_objectives(tmp_path, monkeypatch):
    labels = []
    savefig = figures.plt.Figure.savefig

    def spy(figure, *args, **kwargs):
        labels.extend(ax.get_ylabel() for ax in figure.axes)
        savefig(figure, *args, **kwargs)

    monkeypatch.setattr(figures.plt.Figure, "savefig", spy)
    pairs = (("efficiency", "distance"), ("efficiency", "demo"), ("demo", "distance"))
    rows = [row(DEMO_SPACE, *pair, CircleDemonstrator()) for pair in pairs]
    path = tmp_path / "sweep.png"
    sweep_figure(path, rows, goal_radius=0.3)
    assert is_png(path)
    shown = [
        label.replace("\n", " ").split(" / ")[0]
        for label in labels
        if "/" in label and "weight" not in label
    ]
    shown = [label for label in shown if label not in ("x", "y")]
    human, time = "smallest distance to the human", "time to the goal"
    frechet = "Frechet distance to the demonstration"
    # A column for every sweep, its first objective above its second.
    assert shown == [time, time, frechet, human, frechet, human]


def test_figures_of_a_policy_that_never_arrives(tmp_path):
    """Early in a training: no time to the goal is defined. That is no reason to warn."""
    results = [
        sweep(
            BEND,
            SPACE,
            edge(SPACE, "efficiency", "distance", 2),
            episodes=2,
            seed=0,
            scene=scene,
            max_episode_steps=5,
            num_threads=1,
        )
        for scene in ("showcase", "static")
    ]
    assert results[1].metrics["time"].isnan().all()
    path = tmp_path / "sweep.png"
    sweep_figure(path, [Row("efficiency", "distance", *results)], goal_radius=0.3)
    assert is_png(path)
    assert "  - (0)" in results[1].table()


@pytest.mark.parametrize("steps", [300, 5], ids=["", "ended_before_the_change"])
def test_switch_figure(steps, tmp_path):
    preferences = edge(SPACE, "efficiency", "distance", 2)
    change = switch(BEND, SPACE, preferences, max_episode_steps=steps)
    scene = sweep(
        BEND, SPACE, preferences, episodes=1, seed=0, scene="showcase", max_episode_steps=5
    ).scenes[0]
    path = tmp_path / "switch.png"
    switch_figure(
        path,
        change.paths,
        change.actions,
        scene,
        names=("efficiency", "distance"),
        switch_step=change.switch_step,
        goal_radius=0.3,
    )
    assert is_png(path)


@needs_gl
def test_film_has_every_third_step_of_every_preference(tmp_path):
    path = film(
        tmp_path / "film.gif",
        BEND,
        SPACE,
        SPACE.corners(),
        max_episode_steps=14,
        size=(160, 90),
    )
    frames = imageio.mimread(path)
    assert len(frames) == 2 * 6  # steps 0, 3, 6, 9, 12 and the last one, 14
    # Above and below the picture are bars and a legend.
    assert all(frame.shape[0] > 120 and frame.shape[1] == 160 for frame in frames)
