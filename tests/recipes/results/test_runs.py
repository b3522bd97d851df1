"""One summary of many trainings, by hand."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from recipes.results.runs import find_runs, main, read_run, summarize


def run(folder: Path, overrides: list[str], *cards: tuple[int, dict]) -> Path:
    (folder / ".hydra").mkdir(parents=True)
    (folder / ".hydra" / "overrides.yaml").write_text(yaml.safe_dump(overrides))
    for steps, card in cards:
        policy = folder / "policies" / f"{steps:09d}"
        policy.mkdir(parents=True)
        (policy / "policy.json").write_text(json.dumps({"card": card}))
    return folder


def benchmark(score: float) -> dict:
    return {"score": score, "metrics": {"eval/hypervolume": 10 * score, "eval/steps": None}}


@pytest.fixture
def sweep(tmp_path) -> Path:
    """Five seeds of one setting, with an outlier, and two of another."""
    for seed, score in enumerate((1.0, 2.0, 3.0, 4.0, 1000.0)):
        run(
            tmp_path / str(seed),
            ["env=a", f"seed={seed}"],
            (50, benchmark(0)),
            (100, benchmark(score)),
        )
    for job, score in ((5, 6.0), (10, 8.0)):
        run(tmp_path / str(job), [f"seed={job}", "optim.lr=1", "env=a"], (100, benchmark(score)))
    return tmp_path


def test_seeds_of_a_setting_are_one_interquartile_mean(sweep):
    runs = [read_run(folder) for folder in find_runs([sweep])]
    assert [run.folder.name for run in runs] == ["0", "1", "2", "3", "4", "5", "10"]
    summary = summarize(runs)
    assert list(summary) == [("env=a",), ("env=a", "optim.lr=1")]
    first, second = summary.values()
    assert first["score"].estimate == 3.0 and first["hypervolume"].estimate == 30.0
    assert first["score"].n == 5 and 1 <= first["score"].low <= 3 <= first["score"].high
    assert second["score"].estimate == 7.0
    assert first["steps"].n == 0  # null in every card


def test_the_table_and_the_file(sweep, capsys):
    output = sweep / "summary.csv"
    main([str(sweep), "--output", str(output)])
    printed = capsys.readouterr().out
    assert "| metric | all runs, n = 5 | optim.lr=1, n = 2 |" in printed
    assert "| score | 3 [" in printed and "| steps | - | - |" in printed
    with output.open() as file:
        rows = {(row["setting"], row["metric"]): row for row in csv.DictReader(file)}
    row = rows["env=a optim.lr=1", "hypervolume"]
    assert float(row["iqm"]) == 70.0 and int(row["n"]) == 2
    assert np.isnan(float(rows["env=a", "steps"]["iqm"]))
    with pytest.raises(SystemExit):
        main([str(sweep), "--output", str(output)])
    assert "not overwritten" in capsys.readouterr().err


def test_the_best_policy_and_runs_that_are_not_over(tmp_path, capsys):
    run(tmp_path / "0", ["seed=0"], (50, benchmark(5.0)), (100, benchmark(2.0)))
    run(tmp_path / "1", ["seed=1"], (50, benchmark(3.0)))
    run(tmp_path / "2", ["seed=2"])
    main([str(tmp_path)])
    printed = capsys.readouterr().out
    assert "| score | 2.5 [" in printed
    assert f"{tmp_path / '2'} holds no policy and is left out" in printed
    assert "the policies are of different steps: 100, 50." in printed
    main([str(tmp_path), "--policy", "best"])
    assert "| score | 4 [" in capsys.readouterr().out


def test_navigation_has_a_metric_for_each_preference(tmp_path):
    card = {"score": -1.0, "evaluation": {"preferences": ["demo", "balanced"], "time": [9.0, None]}}
    read = read_run(run(tmp_path / "run", ["seed=0"], (10, card)))
    assert read.metrics["time/demo"] == 9.0 and np.isnan(read.metrics["time/balanced"])


def test_mistakes_are_one_line(tmp_path, capsys):
    broken = run(tmp_path / "broken", ["seed=0"], (10, {"evaluation": 3}))
    empty = run(tmp_path / "empty", ["seed=0"])
    (tmp_path / "no run").mkdir()
    for folder, message in (
        (broken, "is no card of a training"),
        (empty, "no run has been evaluated yet"),
        (tmp_path / "no run", "is no run, and none is in it"),
    ):
        with pytest.raises(SystemExit) as left:
            main([str(folder)])
        (line,) = capsys.readouterr().err.splitlines()
        assert left.value.code == 2 and message in line
