"""Loggers with arguments, as far as their packages are installed; wandb without a network."""

from __future__ import annotations

import importlib
import importlib.util
import sqlite3
from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf

from recipes.training.logs import announce, log_metrics, make_logger, make_loggers


def config(backends: list[str], arguments: dict[str, Any]):
    return OmegaConf.create({"logger": {"backends": backends, "arguments": arguments}})


def logged(run_dir: Path, backend: str, **arguments: Any) -> Any:
    """The logger, after three scalars."""
    if importlib.util.find_spec(backend) is None:
        pytest.skip(f"{backend} is not installed: pip install {backend}")
    (logger,) = make_loggers(config([backend], {backend: arguments}), run_dir)
    for step in (10, 20, 30):
        log_metrics([logger], {"eval/score": step / 2}, step)
    return logger


@pytest.fixture
def run_dir(tmp_path, monkeypatch) -> Path:
    folder = tmp_path / "my run"
    folder.mkdir()
    for name in ("HOME", "TRACKIO_DIR", "WANDB_DIR"):
        monkeypatch.setenv(name, str(tmp_path))
    return folder


def test_wandb_offline(run_dir):
    logger = logged(run_dir, "wandb", offline=True, project="hopper", tags=["seed0"])
    run = logger.experiment
    assert (run.project, run.name, tuple(run.tags)) == ("hopper", "my run", ("seed0",))
    assert run.offline
    assert dict(run.summary)["eval/score"] == 15.0
    run.finish()
    (file,) = run_dir.glob("wandb/offline-run-*/run-*.wandb")
    assert file.stat().st_size > 0


def test_mlflow_in_the_run_folder(run_dir):
    logger = logged(run_dir, "mlflow", tags={"kind": "test"})
    importlib.import_module("mlflow").end_run()
    del logger
    with sqlite3.connect(run_dir / "mlflow.db") as database:
        rows = database.execute("SELECT step, value FROM metrics WHERE key = 'eval/score'")
        assert sorted(rows) == [(10, 5.0), (20, 10.0), (30, 15.0)]
        assert ("my run",) in list(database.execute("SELECT name FROM experiments"))
        assert ("test",) in list(database.execute("SELECT value FROM experiment_tags"))


def test_trackio_in_its_folder(run_dir):
    logger = logged(run_dir, "trackio", project="hopper")
    logger.experiment.finish()
    found = [path for path in run_dir.parent.rglob("*") if path.name.startswith("hopper")]
    assert found, sorted(run_dir.parent.rglob("*"))


def test_csv_and_tensorboard_take_none(run_dir):
    loggers = make_loggers(config(["csv", "tensorboard"], {}), run_dir)
    log_metrics(loggers, {"eval/score": 1.5}, 10)
    assert (run_dir / "log_csv/scalars/eval/score.csv").read_text() == "10,1.5\n"
    assert list((run_dir / "log_tensorboard").iterdir())


def test_what_a_logger_does_not_take_is_one_line(run_dir, monkeypatch):
    class Picky:
        def __init__(self, exp_name: str, project: str) -> None:
            raise AssertionError

    monkeypatch.setattr("recipes.training.logs.TrackioLogger", Picky)
    with pytest.raises(
        ValueError, match=r"logger.backends: trackio with \{'wheels': 3\}: .*wheels"
    ):
        make_logger("trackio", run_dir, {"wheels": 3})


def test_arguments_win_over_what_is_chosen_here(run_dir, monkeypatch):
    given: dict[str, Any] = {}

    class Seen:
        experiment = None

        def __init__(self, **arguments: Any) -> None:
            given.update(arguments)

    monkeypatch.setattr("recipes.training.logs.MLFlowLogger", Seen)
    make_logger("mlflow", run_dir, {})
    assert given == {"exp_name": "my run", "tracking_uri": f"sqlite:///{run_dir}/mlflow.db"}
    make_logger("mlflow", run_dir, {"tracking_uri": "http://localhost:5000", "exp_name": "mine"})
    assert given == {"exp_name": "mine", "tracking_uri": "http://localhost:5000"}


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize("backends", [["csv"], ["csv", "tensorboard"]])
def test_a_training_says_where_to_watch_it_and_why_the_bar_stands(
    compiled, backends, run_dir, capsys
):
    cfg = OmegaConf.merge(config(backends, {}), {"compute": {"compile": compiled}})
    announce(cfg, run_dir)
    said = capsys.readouterr().out
    assert f"a picture at every evaluation: {run_dir / 'pictures'}" in said
    assert (f"tensorboard --logdir '{run_dir}'" in said) == ("tensorboard" in backends)
    assert ("compile their graphs, about a minute, in which the bar stands" in said) == compiled
