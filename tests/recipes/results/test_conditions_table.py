"""The table of all conditions, and the page of what fails."""

from __future__ import annotations

import sys

import matplotlib.pyplot as plt
import numpy as np
import pytest

from envs.demonstrations import StraightDriver
from recipes.results import conditions_table as module
from recipes.results.conditions import condition
from recipes.results.evaluate import evaluate
from recipes.results.files import read_evaluation
from recipes.results.systems import untrained
from tests._results import fabricate

STRAIGHT = untrained("straight", lambda robot: StraightDriver(robot=robot, scaled=True))


@pytest.fixture(scope="module")
def output(tmp_path_factory):
    folder = tmp_path_factory.mktemp("all")
    for name in ("latency_2", "nobody", "wall"):
        evaluate(STRAIGHT, name, folder, episodes=4, seed=7, progress=False)
    return folder


def test_a_row_a_condition_in_the_order_of_the_list(output):
    evaluations = module.read_system(output, "straight")
    assert list(evaluations) == ["nobody", "wall", "latency_2"]
    header, _, *rows = module.conditions_table(evaluations).splitlines()
    assert header.count("|") == 6 and len(rows) == 3
    success = 100 * evaluations["wall"].values("success").mean()
    boxes = 100 * evaluations["wall"].values("collision_obstacle").mean()
    assert rows[1].startswith(f"| `wall` | {success:.1f} [") and f"| {boxes:.1f} |" in rows[1]


def test_the_page_shows_what_fails_most_first(output, tmp_path):
    evaluations = module.read_system(output, "straight")
    shown = module.failures_page(tmp_path / "page.png", evaluations, panels=2)
    rates = [evaluations[name].values("success").mean() for name in shown]
    assert 1 <= len(shown) <= 2 and rates == sorted(rates) and max(rates) < 1
    assert (tmp_path / "page.png").stat().st_size > 10_000


def test_what_another_seed_fails_is_shown(tmp_path, monkeypatch):
    """The first training seed always arrives; of the second, one preference does not, in one scene."""
    evaluation = read_evaluation(fabricate(tmp_path, "OUR", "static"))
    success = evaluation.values("success")
    success[1, 2, 3] = 0
    evaluation.values("timeout")[1, 2, 3] = 1
    saved = []
    monkeypatch.setattr(plt.Figure, "savefig", lambda figure, path, **_: saved.append(figure))
    assert module.failures_page(tmp_path / "x.png", {"static": evaluation}, panels=4) == ["static"]
    (panel, *_) = saved[0].axes
    paths = [
        line for line in panel.lines if len(line.get_xdata()) > 1 and line.get_color() == "0.4"
    ]
    assert len(paths) == 1
    expected = evaluation.trajectories["position"][1, 2, 3]
    np.testing.assert_allclose(paths[0].get_xydata(), expected)


def test_from_the_command_line_nothing_is_overwritten(output, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["conditions_table", str(output)])
    module.main()
    module.main()
    assert (output / "failures_straight.png").exists()
    assert (output / "failures_straight-2.png").exists()
    assert "## straight" in capsys.readouterr().out


def test_a_folder_without_evaluations(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["conditions_table", str(tmp_path)])
    with pytest.raises(SystemExit):
        module.main()
    assert "No evaluation in" in capsys.readouterr().err


def test_robots_that_were_drawn_stay_the_same():
    robots = [condition(f"robot_{place}")["robot"] for place in range(1, 11)]
    assert len(set(robots)) == 10
    first = robots[0]
    assert (first.name, round(first.radius, 2), round(first.max_speed, 2)) == (
        "robot_1",
        0.15,
        0.95,
    )
    for robot in robots:
        assert 0.12 <= robot.radius <= 0.35 and 0.25 <= robot.max_speed <= 1.0
        assert condition(f"crossing+{robot.name}")["scene"] == "crossing"
