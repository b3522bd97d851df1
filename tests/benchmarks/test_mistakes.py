"""Mistakes at the command lines of the benchmarks: one line, and nothing of the user's is overwritten."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import pytest

from recipes.outputs import choose_file

pytestmark = pytest.mark.benchmark
POLICIES = Path(__file__).parents[2] / "recipes" / "policies"
MODULES = ("collecting", "environment", "growth", "learner", "training_step")
MISTAKES = [
    *(
        (name, ["--foo"], "unrecognized arguments: --foo")
        for name in (*MODULES, "lidars", "parity")
    ),
    ("environment", ["--seconds", "-1"], "--seconds: must be a number above 0, got '-1'"),
    ("environment", ["--num-threads", "-1"], "--num-threads: must be a whole number at least 0"),
    ("environment", ["--repetitions", "0"], "--repetitions must be at least 1"),
    ("growth", ["--seconds", "nan"], "--seconds: must be a number from 0, got 'nan'"),
    ("growth", ["--grows", "hair"], "invalid choice: 'hair'"),
    ("training_step", ["--frames", "0"], "--frames: must be a whole number at least 1, got '0'"),
    ("lidars", ["--episodes", "0"], "--episodes: must be a whole number from 1 to 100000"),
    ("lidars", ["--seed", "-1"], "--seed: must be a whole number from"),
    ("lidars", ["--only", "sonar"], "--only sonar: no row is called so; there are native"),
    ("lidars", ["--policy", "nowhere"], "nowhere/policy.safetensors not found"),
    ("parity", ["--inputs", "1"], "--inputs: must be a whole number at least 100, got '1'"),
    ("parity", ["--policy", "nowhere"], "nowhere/policy.safetensors not found"),
    ("parity", ["--policy", str(POLICIES / "navigation")], "the human's position alone"),
    ("parity", ["--policy", str(POLICIES / "our_nh")], "the human's position alone"),
    ("time_to_quality", ["train", "nobody"], "invalid choice: 'nobody'"),
    ("mo_gymnasium", ["run", "--steps", "25000"], "--steps: must be a multiple of 10,000"),
    ("mo_gymnasium", ["run", "--tasks", "hopper"], "invalid choice: 'hopper'"),
    ("mo_gymnasium", ["run", "--algorithms", "td3"], "invalid choice: 'td3'"),
    ("mo_gymnasium", ["run", "--preferences", "1"], "--preferences: must be a whole number from 2"),
    ("mo_gymnasium", ["table", "nowhere"], "must be a folder, 'nowhere' does not exist"),
]


@pytest.mark.parametrize(("name", "arguments", "message"), MISTAKES)
def test_a_mistake_is_one_line(name, arguments, message, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [name, *arguments])
    with pytest.raises(SystemExit) as stop:
        importlib.import_module(f"benchmarks.{name}").main()
    assert stop.value.code == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    (line,) = printed.err.splitlines()
    assert message in line
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", MODULES)
def test_a_file_that_exists_is_refused_before_any_work(name, tmp_path, capsys):
    output = tmp_path / "mine"
    output.write_text("mine")
    with pytest.raises(SystemExit):
        importlib.import_module(f"benchmarks.{name}").main(["--output", str(output)])
    assert f"{output} exists and is not overwritten" in capsys.readouterr().err
    assert output.read_text() == "mine"


def test_without_a_wish_a_number_makes_a_new_name(tmp_path: Path):
    default = tmp_path / "runs" / "rates.csv"
    assert choose_file(None, default) == default
    default.parent.mkdir()
    default.write_text("")
    assert choose_file(None, default) == tmp_path / "runs" / "rates-2.csv"
    (tmp_path / "runs" / "rates-2.csv").symlink_to("nowhere")
    assert choose_file(None, default) == tmp_path / "runs" / "rates-3.csv"
