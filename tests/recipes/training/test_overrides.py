"""Overrides: what Hydra's grammar cannot read is quoted, and several values are several jobs."""

from __future__ import annotations

from pathlib import Path

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

import recipes
from recipes.pd_morl.schema import Config
from recipes.training.overrides import jobs, prepared
from recipes.training.quoting import quoted

FOLDER = Path(recipes.__file__).parent / "pd_morl"
PATHS = (
    "runs/drex",
    "a b",
    "ä/ö",
    "a=b",
    "a,b",
    "(1)",
    "[x]",
    "{x}",
    "it's",
    'say "x"',
    "a\\b",
    "a\\",
    "$x",
    "1",
    "null",
    "a:b",
    "#",
    "a'\\'b",
    "日本",
)


def read(override: str) -> object:
    return OverridesParser.create().parse_override(override).value()


@pytest.mark.parametrize("path", PATHS)
def test_what_is_quoted_is_read_as_it_was(path):
    value = read(f"key={quoted(path)}")
    assert getattr(value, "text", value) == path


@pytest.mark.parametrize("path", [path for path in PATHS if path not in ("null", "{x}")])
@pytest.mark.parametrize(
    "field", ["demonstrations.reward_model", "demonstrations.dataset", "hydra.run.dir", "env.robot"]
)
def test_paths_of_fields_are_read_as_they_were_given(path, field, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    if "\\" in path:  # an escape of Hydra's, unless there is such a file
        Path(path).write_text("")
    (override,) = prepared([f"{field}={path}"], Config, FOLDER)
    value = read(override)
    assert getattr(value, "text", value) == path


@pytest.mark.parametrize(
    ("given", "made"),
    [
        ("seed=1", "seed=1"),
        ("+seed=1", "seed=1"),
        ("++seed=1", "seed=1"),
        ("demonstrations.dataset=null", "demonstrations.dataset=null"),
        ("demonstrations.dataset=", "demonstrations.dataset="),
        ("demonstrations.dataset='a b'", "demonstrations.dataset='a b'"),
        (r"demonstrations.dataset=a\,b", r"demonstrations.dataset=a\,b"),
        ("env.robot={name: x}", "env.robot={name: x}"),
        ("env.faults.latency=1", "++env.faults.latency=1"),
        ("env.rewards={goal_reward: 5}", "++env.rewards={goal_reward: 5}"),
        ("env.rewards.goal_reward=5", "++env.rewards.goal_reward=5"),
        ("preset=quick", "preset=quick"),
        ("hydra.verbose=true", "hydra.verbose=true"),
        ("loss.loss_function=l2", "loss.loss_function=l2"),
    ],
)
def test_overrides_as_hydra_takes_them(given, made, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert prepared([given], Config, FOLDER) == [made]


def test_in_a_multirun_a_comma_is_two_values():
    given = ["demonstrations.dataset=a,b"]
    assert prepared(given, Config, FOLDER, multirun=True) == given
    assert prepared(given, Config, FOLDER) == ["demonstrations.dataset='a,b'"]


def test_jobs_of_a_multirun():
    assert list(jobs(["seed=0,1", "loss.gamma=0.9", "env.scene=static,mixed"])) == [
        [f"seed={seed}", "loss.gamma=0.9", f"env.scene={scene}"]
        for seed in (0, 1)
        for scene in ("static", "mixed")
    ]
    assert list(jobs(["seed=range(3)"])) == [["seed=0"], ["seed=1"], ["seed=2"]]
    assert list(jobs([])) == [[]]
