"""A folder without a policy is refused in one line that says where there are some."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import pytest

from recipes.policy_folders import SHIPPED, no_policy, policy_folder
from recipes.results.systems import load_system
from recipes.training.fields import IsPath

ROOT = SHIPPED.parents[1]
COMMANDS = {
    "recipes.evaluate": [],
    "recipes.film": ["--output", "film.gif"],
    "recipes.demo.__main__": [],
    "recipes.choices.__main__": [],
    "recipes.choices.evidence": [],
    "recipes.page.__main__": [],
    "benchmarks.lidars": [],
    "benchmarks.parity": [],
}


def write_policy(folder: Path) -> Path:
    folder.mkdir(parents=True)
    for name in ("policy.safetensors", "policy.json"):
        (folder / name).write_text("")
    return folder


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_says_what_is_there(command, monkeypatch, capsys, tmp_path):
    write_policy(tmp_path / "mine" / "walker")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [command, "--policy", "mine/walkr", *COMMANDS[command]])
    with pytest.raises(SystemExit) as stop:
        importlib.import_module(command).main()
    assert stop.value.code == 2
    printed = capsys.readouterr()
    (line,) = printed.err.splitlines()
    assert printed.out == ""
    assert "mine/walkr/policy.safetensors not found: a policy is a folder with" in line
    assert line.endswith("; mine has walker: did you mean walker?")
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


def test_a_field_of_a_recipe_and_a_system_say_it_too(tmp_path, monkeypatch):
    write_policy(tmp_path / "walker")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=r"policy=other: other/policy.* not found.*has walker"):
        IsPath("policy").check("policy", "other")
    with pytest.raises(FileNotFoundError, match=r"OUR: other/policy.* not found.*has walker"):
        load_system("OUR=other")


@pytest.mark.parametrize(
    ("path", "hint"),
    [
        ("recipes/policies/navigatoin", "did you mean navigation?"),
        ("recipes/polices/navigation", "did you mean policies/navigation?"),
        ("navigation", "did you mean navigation?"),
        ("recipes/policies/navigation/policy.json", "did you mean recipes/policies/navigation?"),
        ("recipes/policies/navigation/deeper", "did you mean recipes/policies/navigation?"),
        ("recipes/policies", "recipes/policies has behaviour_clone, capql, core"),
        ("nowhere/at/all", "recipes/policies has behaviour_clone, capql, core"),
    ],
)
def test_what_is_meant(path, hint, monkeypatch):
    monkeypatch.chdir(ROOT)
    assert hint in no_policy(Path(path))


def test_the_policies_of_a_run_are_found(tmp_path):
    write_policy(tmp_path / "run" / "policies" / "1024")
    assert no_policy(tmp_path / "run").endswith("run has policies/1024")


def test_half_a_policy_is_none(tmp_path):
    (write_policy(tmp_path / "half") / "policy.json").unlink()
    assert f"{tmp_path / 'half' / 'policy.json'} not found" in no_policy(tmp_path / "half")


def test_a_policy_is_taken():
    assert policy_folder(str(SHIPPED / "navigation")) == SHIPPED / "navigation"


def test_many_policies_and_strange_names_are_one_line(tmp_path):
    write_policy(tmp_path / "a\nb")
    for number in range(40):
        write_policy(tmp_path / f"p{number:02d}")
    why = no_policy(tmp_path / "zzz")
    assert len(why.splitlines()) == 1
    assert why.endswith("p28 and 11 more")
