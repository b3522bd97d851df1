"""A run folder that somebody else made tells a resume nothing but fields of the recipe, and runs nothing."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml

import recipes
from recipes import stages
from recipes.benchmark.schema import PDMORLConfig
from recipes.pd_morl.schema import Config
from recipes.record import Record, to_resume
from recipes.training.overrides import prepared, resumed
from recipes.training.run_folder import is_over, score
from recipes.training.validation import ConfigurationError
from tests._command import run

FOLDER = Path(recipes.__file__).parent / "pd_morl"
# Hydra itself refuses many targets, but not this one, which starts a shell.
RUNS = "{{_target_: torch.utils.collect_env.run, command: 'touch {0}'}}"


def run_folder(folder: Path, *overrides: object) -> Path:
    (folder / ".hydra").mkdir(parents=True)
    (folder / ".hydra" / "overrides.yaml").write_text(yaml.safe_dump(list(overrides)))
    (folder / "checkpoints").mkdir()
    return folder


def test_what_a_run_was_configured_with_is_taken(tmp_path):
    given = ["seed=3", "++env.faults.latency=1", "demonstrations.dataset='a b'", "preset=quick"]
    folder = run_folder(tmp_path / "run", *given, "resume=elsewhere")
    asked = prepared([f"resume={folder}", "seed=4"], Config, FOLDER)
    assert resumed(asked, Config, FOLDER) == [*given, *asked, f"hydra.run.dir={folder}"]


@pytest.mark.parametrize("quotes", ["", "'"])
def test_a_module_is_imported_when_the_user_says_so(quotes, tmp_path, monkeypatch):
    """A run folder may hold Python files: from the current folder they can be imported."""
    monkeypatch.chdir(tmp_path)
    benchmark = Path(recipes.__file__).parent / "benchmark"
    env = f"env={quotes}runs.theirs.evil:Evil-v0{quotes}"
    folder = run_folder(tmp_path / "runs" / "theirs", env, "seed=3")
    (folder / "evil.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')\n")
    asked = prepared([f"resume={folder}"], PDMORLConfig, benchmark)
    with pytest.raises(ConfigurationError, match=r"imports a module, .*; give it yourself"):
        resumed(asked, PDMORLConfig, benchmark)
    assert not (tmp_path / "ran").exists()
    asked = prepared([f"resume={folder}", "env=mo-hopper-v5"], PDMORLConfig, benchmark)
    assert resumed(asked, PDMORLConfig, benchmark)[-3:-1] == asked


@pytest.mark.parametrize(
    "override",
    [
        "hydra.callbacks.x=" + RUNS,
        "+hydra.callbacks.x=" + RUNS,
        "++hydra.callbacks.x._target_=os.system",
        "~hydra.callbacks",
        " +hydra.callbacks.x=" + RUNS,
        "+ hydra.callbacks.x=1",
        "hydra/launcher=basic",
        "hydra.run.dir=elsewhere",
        "preset@hydra.callbacks=quick",
        "preset@_global_=quick",
        "preset=../../../evil",
        "preset=/tmp/evil",
        "preset=[quick,../evil]",
        "preset=..\\evil",
        "../pd_morl/preset=quick",
        "/tmp=evil",
        "..=evil",
        ".=evil",
        "=evil",
        "env.robot=${oc.env:SECRET}",
        "env._target_=os.system",
        "+_target_=os.system",
        "seed",
        7,
        ["seed=1"],
    ],
)
def test_anything_else_is_refused_in_one_line(override, tmp_path):
    flag = tmp_path / "flag"
    if isinstance(override, str):
        override = override.format(flag) if "{0}" in override else override
    folder = run_folder(tmp_path / "run", override)
    with pytest.raises(ConfigurationError) as refused:
        resumed([f"resume={folder}"], Config, FOLDER)
    assert len(str(refused.value).splitlines()) == 1
    assert str(folder / ".hydra" / "overrides.yaml") in str(refused.value)


def test_a_command_that_goes_on_there_runs_nothing(tmp_path):
    flag = tmp_path / "flag"
    folder = run_folder(tmp_path / "run", "+hydra.callbacks.x=" + RUNS.format(flag))
    result = run("recipes.pd_morl.pd_morl", f"resume={folder}")
    assert result.returncode == 2
    (line,) = result.stderr.splitlines()
    assert "is not taken from a folder" in line
    assert not flag.exists()


@pytest.mark.parametrize("group", ["preset=../evil", "preset=/tmp/evil", "../pd_morl/preset=quick"])
def test_a_preset_is_one_of_the_recipe(group):
    with pytest.raises(ConfigurationError):
        prepared([group], Config, FOLDER)


OPTIONS = {"drex": [], "pd_morl": [], "mo_ppo": [], "without_mo_ppo": True, "episodes": 1}
TYPES = {"drex": list, "pd_morl": list, "mo_ppo": list, "without_mo_ppo": bool, "episodes": int}


@pytest.mark.parametrize(
    ("options", "its_stages"),
    [
        ({"drex": ["+hydra.callbacks.x={_target_: os.system}"]}, {}),
        ({"drex": ["env.robot=${oc.env:SECRET}"]}, {}),
        ({"drex": [["seed=1"]]}, {}),
        ({"drex": "seed=1"}, {}),
        ({"drex": None}, {}),
        ({"episodes": "4"}, {}),
        ({"episodes": True}, {}),
        ({"without_mo_ppo": 0}, {}),
        ({"more": 1}, {}),
        ({}, {"D-REX": {"folder": "/etc", "seconds": 1.0}}),
        ({}, {"D-REX": {"folder": "../elsewhere", "seconds": 1.0}}),
        ({}, {"D-REX": {"folder": "", "seconds": 1.0}}),
        ({}, {"D-REX": {"folder": 7, "seconds": 1.0}}),
        ({}, {"D-REX": ["drex"]}),
        ({}, {"D-REX": None}),
    ],
)
def test_a_record_says_nothing_but_what_a_command_writes(options, its_stages, tmp_path):
    content = {"options": OPTIONS | options, "stages": its_stages, "finished": False}
    (tmp_path / "stages.json").write_text(json.dumps(content))
    with pytest.raises(ValueError, match=r"stages\.json") as refused:
        to_resume(tmp_path, **TYPES)
    assert len(str(refused.value).splitlines()) == 1


def test_a_record_of_the_command_is_taken(tmp_path):
    record = Record(tmp_path, OPTIONS)
    record.begin("D-REX", ["recipes.drex.drex"], "drex")
    record.begin("evaluation", ["recipes.evaluate"], None)
    assert to_resume(tmp_path, **TYPES) == record


@pytest.mark.parametrize(
    "override", ["+hydra.callbacks.x=1", "hydra/launcher=a", "hydra.verbose=1"]
)
def test_a_stage_takes_nothing_of_hydra(override):
    with pytest.raises(ValueError, match="a stage takes fields of its own, not Hydra's"):
        stages.refuse_places("--drex", [override])


@pytest.mark.parametrize(
    "text", ["", "[]", "7", "collector: 7", "collector: {total_frames: a}", "a: [", "!!python/x 1"]
)
def test_a_configuration_that_is_none_is_no_end_of_a_training(text, tmp_path):
    (tmp_path / "checkpoints" / "checkpoint-000000000960").mkdir(parents=True)
    (tmp_path / ".hydra").mkdir()
    (tmp_path / ".hydra" / "config.yaml").write_text(text)
    assert not is_over(tmp_path)


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"card": []}', '{"card": {"score": "a"}}'])
def test_a_policy_without_a_score_is_named(text, tmp_path):
    (tmp_path / "policy.json").write_text(text)
    with pytest.raises(ValueError, match=r"policy\.json does not say the score of the policy"):
        score(tmp_path)
