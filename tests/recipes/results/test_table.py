"""Table I from evaluations made by hand: every number can be worked out."""

from __future__ import annotations

import dataclasses
import shutil
import sys

import numpy as np
import pytest
import scipy.stats

from recipes.results import paper, table
from recipes.results.comparison import (
    QUANTITIES,
    exposure_steering,
    goodness,
    indicators,
    ratio_to_bound,
    steering,
)
from recipes.results.files import read_evaluation, read_evaluations
from tests._results import SCENES, STEPS, fabricate

EPISODES = 2 * 3 * STEPS * SCENES


@pytest.fixture(scope="module")
def output(tmp_path_factory):
    folder = tmp_path_factory.mktemp("results")
    fabricate(folder, "OUR", failures=2)
    fabricate(folder, "NH", seeds=(0,), shift=0.5)
    fabricate(folder, "CORE", seeds=(0,), ignored=True)
    return folder


@pytest.fixture(scope="module")
def evaluations(output):
    return {name: read_evaluation(output / name / "static") for name in ("OUR", "NH", "CORE")}


def test_numbers_of_the_main_table(evaluations):
    our = {name: one.interval(evaluations["OUR"]) for name, one in QUANTITIES.items()}
    assert our["success"].n == our["timeout"].n == EPISODES
    assert our["success"].estimate == pytest.approx(100 * (1 - 2 / EPISODES))
    assert our["timeout"].estimate == pytest.approx(100 * 2 / EPISODES)
    assert our["collision"].estimate == our["collision"].low == 0 < our["collision"].high
    # Each at its own preference; scenes 0 to 3, training seeds 0 and 0.01 above.
    assert our["min_human_distance"].estimate == pytest.approx(0.8 + 0.15 + 0.005 + 0.5)
    assert our["frechet"].estimate == pytest.approx(1.5 + 0.15 + 0.005 - 1)
    assert our["frechet_free"].estimate == pytest.approx(1.5 + 0.2 + 0.005 - 1)
    assert (our["frechet"].n, our["frechet_free"].n) == (2 * SCENES, SCENES)
    # The two failures are scenes 0 and 1 of the first training seed, under efficiency.
    assert our["time"].n == 2 * SCENES - 2
    assert our["time"].estimate == pytest.approx(np.mean([20, 21, 18.01, 19.01, 20.01, 21.01]))


def test_a_system_without_preferences_has_its_only_numbers(evaluations):
    core = {name: one.interval(evaluations["CORE"]) for name, one in QUANTITIES.items()}
    assert core["success"].n == SCENES
    assert core["min_human_distance"].estimate == pytest.approx(0.95)
    assert core["time"].estimate == pytest.approx(21.5)
    assert steering(evaluations["CORE"]) == indicators(evaluations["CORE"]) == {}


def test_evaluations_of_before_exposure_have_none(evaluations):
    older = dataclasses.replace(
        evaluations["NH"],
        columns={k: v for k, v in evaluations["NH"].columns.items() if k != "human_exposure"},
    )
    assert np.isnan(exposure_steering(older))
    assert steering(older) == steering(evaluations["NH"])


def test_training_seeds_one_by_one(evaluations):
    assert QUANTITIES["success"].per_seed(evaluations["OUR"]) == pytest.approx(
        [100 * (1 - 2 / (EPISODES / 2)), 100]
    )
    assert QUANTITIES["frechet"].per_seed(evaluations["OUR"]) == pytest.approx([0.65, 0.66])
    assert QUANTITIES["frechet"].robust(evaluations["OUR"]) == pytest.approx(0.655)


def test_time_against_its_bounds(evaluations):
    # Efficiency takes 2 s off, the straight line takes 16, 18, 20 and 22 s.
    assert ratio_to_bound(evaluations["NH"], "straight_time") == pytest.approx(
        (21.5 + 0.5 - 2) / 19
    )
    assert ratio_to_bound(evaluations["NH"], "shortest_time") == pytest.approx(20 / 20)
    # Failures count in neither: 20 and 22 s of the first training seed, all of the second.
    bound = np.mean([20, 22, 16, 18, 20, 22])
    time = np.mean([20, 21, 18.01, 19.01, 20.01, 21.01])
    assert ratio_to_bound(evaluations["OUR"], "straight_time") == pytest.approx(time / bound)


def test_steering_and_indicators(evaluations):
    assert steering(evaluations["NH"]) == pytest.approx(
        {"demo": -1, "distance": 1, "efficiency": -1}
    )
    assert exposure_steering(evaluations["NH"]) == pytest.approx(-1)
    assert np.isnan(exposure_steering(evaluations["CORE"]))
    values = goodness(evaluations["NH"])
    assert values.shape == (3 * STEPS, 3) and (values >= 0).all() and (values <= 1).all()
    # demo = 1: Frechet distances of 1.0 to 1.3 m out of 3.
    assert values[evaluations["NH"].corner("demo"), 0] == pytest.approx(1 - 1.15 / 3)
    # distance = 1: 1.8 to 2.1 m between the centres, of which 0.5 m are contact; 2 m are enough.
    assert values[evaluations["NH"].corner("distance"), 1] == pytest.approx(
        np.mean([1.3 / 1.5, 1.4 / 1.5, 1, 1])
    )
    found = indicators(evaluations["NH"])
    assert 0 < found["hypervolume"] < 1
    assert found["expected utility"] <= found["expected utility, best"] <= 1


def test_significance_is_paired_over_scenes(evaluations):
    rng = np.random.default_rng(0)
    frechet = evaluations["NH"].columns["frechet"]
    noisy = frechet + 0.1 * rng.normal(size=frechet.shape)
    nh = evaluations["NH"]
    changed = type(nh)(nh.folder, nh.summary, nh.columns | {"frechet": noisy})
    test = QUANTITIES["frechet"].test(changed, evaluations["OUR"], comparisons=7)
    row = nh.corner("demo")
    first = noisy.reshape(-1, SCENES)[row]
    second = evaluations["OUR"].values("frechet")[:, row].mean(0)
    expected = scipy.stats.ttest_rel(first, second)
    assert test.p_single == pytest.approx(expected.pvalue)
    assert test.p == pytest.approx(min(1, 7 * expected.pvalue))
    assert test.difference == pytest.approx((first - second).mean())
    assert test.n == (SCENES, SCENES)


def test_report(output, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["table", str(output)])
    table.main()
    printed = capsys.readouterr().out
    text = (output / "table.md").read_text()
    assert text in printed
    lines = text.splitlines()
    order = [line.split("|")[1].strip() for line in lines if line.startswith("| **")]
    assert order == ["**OUR**", "**NH**", "**CORE**"]
    paper_row = next(line for line in lines if line.startswith("| OUR in the paper"))
    assert [cell.strip() for cell in paper_row.split("|")[3:-1]] == [
        "100", "0", "0", "1.18", "0.41", "-", "17.3"
    ]  # fmt: skip
    assert "corrected for 14 comparisons (Bonferroni)" in text
    assert "| NH - OUR |" in text and "| CORE - OUR |" in text
    for one in (line for line in lines if line.startswith("|")):
        assert one.count("|") >= 9


def test_the_papers_row_stands_in_its_own_condition_alone(tmp_path):
    fabricate(tmp_path, condition="moving_human")
    text = table.report(read_evaluations(tmp_path, "moving_human"))
    assert "in the paper" not in text and "paper's numbers" not in text


def test_the_table_says_what_is_missing(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["table", str(tmp_path)])
    with pytest.raises(SystemExit):
        table.main()
    assert "python -m recipes.results.evaluate" in capsys.readouterr().err


def test_numbers_of_the_paper_have_a_column():
    assert set(paper.COLUMNS) <= set(QUANTITIES)
    assert all(len(row) == len(paper.COLUMNS) for row in paper.TABLE.values())


def test_what_a_killed_evaluation_leaves_is_not_counted(output, tmp_path, monkeypatch, capsys):
    folder = tmp_path / "results"
    shutil.copytree(output, folder)
    for partial in (folder / "OUR" / ".static.4711", folder / ".OUR"):
        shutil.copytree(output / "OUR" / "static", partial)
    monkeypatch.setattr(sys, "argv", ["table", str(folder)])
    table.main()
    with_it = capsys.readouterr().out
    monkeypatch.setattr(sys, "argv", ["table", str(shutil.copytree(output, tmp_path / "clean"))])
    table.main()
    assert with_it.replace(str(folder), "") == capsys.readouterr().out.replace(
        str(tmp_path / "clean"), ""
    )
