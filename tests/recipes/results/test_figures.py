"""Figures from evaluations made by hand: what they show, and what they refuse."""

from __future__ import annotations

import dataclasses
import sys

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.colors import to_rgb

from recipes.objectives import OBJECTIVES, edge_map, preference_colors
from recipes.results import figures
from recipes.results.files import read_evaluation
from recipes.results.panels import Column
from recipes.results.qualitative import pick_scenes, qualitative_figure
from recipes.results.quantitative import corner_tests, quantitative_figure
from tests._results import fabricate


@pytest.fixture(scope="module")
def output(tmp_path_factory):
    folder = tmp_path_factory.mktemp("results")
    for condition in ("static", "moving_human", "corridor"):
        fabricate(folder, "OUR", condition)
    fabricate(folder, "CORE", ignored=True)
    return folder


@pytest.fixture
def drawn(monkeypatch):
    """The figures that were saved."""
    saved = []
    original = plt.Figure.savefig

    def spy(figure, *args, **kwargs):
        saved.append(figure)
        kwargs["dpi"] = 40
        original(figure, *args, **kwargs)

    monkeypatch.setattr(plt.Figure, "savefig", spy)
    return saved


def test_both_figures_from_the_command_line(output, monkeypatch, capsys, drawn):
    monkeypatch.setattr(sys, "argv", ["figures", str(output)])
    figures.main()
    assert "without" not in capsys.readouterr().out
    for name in ("quantitative", "qualitative"):
        assert (output / f"OUR_{name}.png").read_bytes().startswith(b"\x89PNG")
    numbers, pictures = drawn
    assert len(numbers.axes) == 5
    assert all(" / " in ax.get_ylabel() for ax in numbers.axes[:4])  # units
    panels = [ax for ax in pictures.axes if ax.get_label() != "<colorbar>"]
    assert len(panels) == 15
    titles = [ax.get_title() for ax in panels[:5]]
    assert [title[0] for title in titles] == list("ABCDE")
    assert titles[4].startswith("E: corridor")


def test_scenes_can_be_chosen(output, monkeypatch, capsys):
    arguments = ["--scenes", "static=2", "corridor=0,1"]
    evaluations = {name: read_evaluation(output / "OUR" / name) for name in ("static", "corridor")}
    columns = figures.choose_columns(evaluations, figures.parse_scenes(arguments[1:]))
    assert [column.scene for column in columns] == [2, 0, 1]
    for text, message in (("static=9", "no scene 9"), ("hsr=1", "hsr was not evaluated")):
        with pytest.raises(ValueError, match=message):
            figures.choose_columns(evaluations, figures.parse_scenes([text]))
    with pytest.raises(ValueError, match="write CONDITION=3,8, got 'static=x'"):
        figures.parse_scenes(["static=x"])


def test_free_and_near_scenes_come_first(output):
    """Odd scenes are free; goals are 8.3 to 11.3 m away."""
    evaluation = read_evaluation(output / "OUR" / "static")
    assert pick_scenes(evaluation, 4, longest=9.0) == [1, 3, 0, 2]
    assert pick_scenes(evaluation, 1, longest=20.0) == [1]


def test_tests_between_neighbouring_corners(output):
    """Three segments between corners; each corner stands twice, beside itself."""
    evaluation = read_evaluation(output / "OUR" / "static")
    found = corner_tests(evaluation, "time")
    assert list(found) == [(0, 2), (3, 5), (6, 8)]
    # The same difference in all scenes has no spread to test against.
    assert np.isnan(list(found.values())).all()


def test_what_ignores_preferences_has_no_figures(output, tmp_path):
    core = read_evaluation(output / "CORE" / "static")
    with pytest.raises(ValueError, match="CORE ignores preferences"):
        quantitative_figure(tmp_path / "a.png", core)
    with pytest.raises(ValueError, match="CORE ignores preferences"):
        qualitative_figure(tmp_path / "b.png", [Column(core, 0, "A")])
    with pytest.raises(ValueError, match="No scenes"):
        qualitative_figure(tmp_path / "c.png", [])


def test_a_core_far_away_does_not_flatten_a_panel(output, tmp_path, drawn):
    evaluation, core = (read_evaluation(output / name / "static") for name in ("OUR", "CORE"))
    quantitative_figure(tmp_path / "near.png", evaluation, core)
    slow = {**core.columns, "time": core.columns["time"] + 1000}
    quantitative_figure(tmp_path / "far.png", evaluation, dataclasses.replace(core, columns=slow))
    near, far = (figure.axes[0] for figure in drawn)
    assert far.get_ylim()[1] < 100
    assert any(text.get_text().startswith("CORE: 1") for text in far.texts)
    assert not any(text.get_text().startswith("CORE") for text in near.texts)
    assert len(far.lines) == len(near.lines) - 1


def test_missing_conditions_are_named(tmp_path, monkeypatch, capsys, drawn):
    fabricate(tmp_path, "OUR")
    monkeypatch.setattr(sys, "argv", ["figures", str(tmp_path)])
    figures.main()
    assert "without corridor: python -m recipes.results.evaluate" in capsys.readouterr().out
    monkeypatch.setattr(sys, "argv", ["figures", str(tmp_path), "--system", "NH"])
    with pytest.raises(SystemExit):
        figures.main()
    assert "no evaluation" in capsys.readouterr().err


def test_colors_of_preferences():
    objectives = ["demo", "distance", "efficiency"]
    colors = preference_colors(np.eye(3), objectives)
    np.testing.assert_allclose(colors, [to_rgb(OBJECTIVES[name].color) for name in objectives])
    between = preference_colors([[0.0, 0.5, 0.5]], objectives)[0]
    np.testing.assert_allclose(between, edge_map("distance", "efficiency")(0.5)[:3], atol=0.01)
    with pytest.raises(ValueError, match="objective 'comfort' has no row"):
        preference_colors([[1.0]], ["comfort"])


def lightness(color: str) -> float:
    """L* of CIELAB, from 0 to 100."""
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in to_rgb(color)]
    return 116 * float(np.dot(linear, [0.2126, 0.7152, 0.0722])) ** (1 / 3) - 16


def test_corners_differ_in_lightness():
    """So that they are told apart without hue, the paper's three more than a fourth."""
    assert lightness("#ffffff") == pytest.approx(100)
    levels = {name: lightness(objective.color) for name, objective in OBJECTIVES.items()}
    paper = sorted(levels[name] for name in ("demo", "distance", "efficiency"))
    assert np.diff(paper).min() > 20
    assert np.diff(sorted(levels.values())).min() > 10
