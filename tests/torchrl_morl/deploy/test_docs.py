"""The page on deployment: its program runs as it stands, and what it names exists."""

from __future__ import annotations

import re
from pathlib import Path
from typing import get_args

import torchrl_morl.deploy as deploy
from torchrl_morl.deploy import load_policy
from torchrl_morl.deploy.runner import Reason

ROOT = Path(__file__).parents[3]
PAGE = (ROOT / "docs" / "deploy.md").read_text()


def test_the_program_runs(monkeypatch, capsys):
    monkeypatch.chdir(ROOT)
    (program,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    exec(compile(program, "docs/deploy.md", "exec"), {})
    speed, turn_rate, reason = capsys.readouterr().out.split()
    assert reason == "drive" and 0 < float(speed) <= 0.5 and abs(float(turn_rate)) < 3.2


def test_every_reason_is_explained():
    explained = set(re.findall(r"^\| `([a-z ]+)` \|", PAGE, re.MULTILINE))
    assert set(get_args(Reason)) - {"drive"} <= explained


def test_the_numbers_are_those_of_the_policies():
    sensing = load_policy(ROOT / "recipes/policies/polished_seed0").sensing
    assert sensing.nobody[0] == 4.0 and sensing.goal_range[1] == 12.0
    assert sensing.human_range[1] == 8.0 and sensing.unknown_range == sensing.max_range
    navigation = load_policy(ROOT / "recipes/policies/navigation").sensing
    assert navigation.goal_range[1] == navigation.human_range[1] == 15.0


def test_what_it_names_exists():
    for name in ("literal_config", "Sensing", "Limits", "PolicyRunner"):
        assert name in PAGE
        assert hasattr(deploy, name)
