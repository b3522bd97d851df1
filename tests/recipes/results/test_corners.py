"""The picture of the corners, from evaluations made by hand."""

from __future__ import annotations

import sys

import matplotlib.pyplot as plt
import pytest
from matplotlib.colors import to_hex

from recipes.objectives import OBJECTIVES
from recipes.results import corners
from recipes.results.files import read_evaluation
from recipes.results.panels import Column
from tests._results import fabricate


@pytest.fixture
def drawn(monkeypatch):
    saved = []
    monkeypatch.setattr(
        plt.Figure, "savefig", lambda figure, path, **_: saved.append(figure) or path.touch()
    )
    return saved


def run(monkeypatch, *arguments: object) -> None:
    monkeypatch.setattr(sys, "argv", ["corners", *map(str, arguments)])
    corners.main()


def test_a_panel_a_scene_with_a_line_a_corner(tmp_path, monkeypatch, drawn, capsys):
    fabricate(tmp_path, "OUR", "static")
    fabricate(tmp_path, "OUR", "moving_human")
    run(monkeypatch, tmp_path, "--condition", "static", "moving_human", "--count", 3)
    assert (tmp_path / "OUR_corners.png").is_file() and "written" in capsys.readouterr().out
    panels = [ax for ax in drawn[0].axes if ax.get_title()]
    assert [ax.get_title() for ax in panels] == [
        *(f"static ({scene})" for scene in range(3)),
        *(f"moving human ({scene})" for scene in range(3)),
    ]
    evaluation = read_evaluation(tmp_path / "OUR" / "static")
    for ax in panels:
        colors = {to_hex(line.get_color()) for line in ax.lines}
        assert {OBJECTIVES[name].color for name in evaluation.objectives} <= colors


def test_what_fails_has_a_cross(tmp_path, drawn):
    fabricate(tmp_path, "OUR", "static")
    evaluation = read_evaluation(tmp_path / "OUR" / "static")
    success = evaluation.values("success")
    rows = [evaluation.corner(name) for name in evaluation.objectives]
    scenes = range(evaluation.summary["episodes"])
    corners.corners_figure(
        tmp_path / "x.png", [Column(evaluation, scene, str(scene)) for scene in scenes]
    )
    panels = [ax for ax in drawn[0].axes if ax.get_title()]
    for scene, ax in zip(scenes, panels, strict=True):
        crosses = sum(line.get_marker() == "x" for line in ax.lines)
        assert crosses == sum(not success[0, row, scene] for row in rows)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--condition", "nowhere"], "nowhere"),
        (["--count", "0"], "--count"),
        (["--system", "CORE"], "CORE ignores preferences"),
    ],
)
def test_refusals_are_one_line(arguments, message, tmp_path, monkeypatch, capsys):
    fabricate(tmp_path, "OUR", "static")
    fabricate(tmp_path, "CORE", ignored=True)
    with pytest.raises(SystemExit):
        run(monkeypatch, tmp_path, *arguments)
    assert message in capsys.readouterr().err.splitlines()[-1]
