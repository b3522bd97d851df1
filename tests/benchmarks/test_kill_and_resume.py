"""Kills at random moments: the comparison sees one bit, the moments are seeded, nobody survives."""

from __future__ import annotations

import itertools
import json
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from benchmarks import kill_and_resume
from benchmarks.kill_and_resume import Run, differences, left, moments

pytestmark = pytest.mark.benchmark


def training(folder: Path, *, weight: float = 0.5, score: float = 1.0) -> Path:
    policy = folder / "mo_ppo" / "policies" / "000000128"
    policy.mkdir(parents=True)
    (folder / "drex" / "reward_model").mkdir(parents=True)
    tensors = {"weight": torch.full((3, 2), 0.5), "scale": torch.tensor(weight), "n": torch.ones(2)}
    save_file(tensors, policy / "policy.safetensors")
    save_file(
        {"weight": torch.zeros(4, dtype=torch.bool)}, folder / "drex/reward_model/r.safetensors"
    )
    card = {"score": score, "evaluation": {"success": [score]}, "config": {"at": str(folder)}}
    (policy / "policy.json").write_text(json.dumps({"card": card}))
    # Neither checkpoints nor what was never finished counts.
    for name in ("mo_ppo/checkpoints/checkpoint-1", "mo_ppo/policies/.000000256.a1"):
        (folder / name).mkdir(parents=True)
        save_file({"x": torch.rand(1)}, folder / name / "state.safetensors")
    return folder


def test_what_is_the_same_is_equal_wherever_it_lies(tmp_path):
    one, other = (left(training(tmp_path / name)) for name in "ab")
    assert len(one) == 5
    assert differences(one, other) == []


def test_one_flipped_bit_is_seen_and_named(tmp_path):
    one = left(training(tmp_path / "a"))
    next_to = torch.nextafter(torch.tensor(0.5), torch.tensor(1.0)).item()
    other = left(training(tmp_path / "b", weight=next_to))
    assert differences(one, other) == ["mo_ppo/policies/000000128/policy.safetensors: scale"]


def test_zero_and_minus_zero_differ_and_nan_equals_itself(tmp_path):
    zero, minus, nan, again = (
        left(training(tmp_path / str(place), weight=value))
        for place, value in enumerate((0.0, -0.0, float("nan"), float("nan")))
    )
    assert len(differences(zero, minus)) == 1
    assert differences(nan, again) == []


def test_another_evaluation_or_a_missing_policy_is_seen(tmp_path):
    one, other = left(training(tmp_path / "a")), left(training(tmp_path / "b", score=2.0))
    assert differences(one, other) == ["mo_ppo/policies/000000128/policy.json: evaluation"]
    lost = {name: value for name, value in one.items() if "reward_model" not in name}
    assert differences(one, lost) == ["drex/reward_model/r.safetensors: weight"]


def test_moments_are_seeded_and_within_the_wall_time():
    def first(seed: int) -> list[float]:
        return list(itertools.islice(moments(seed, 20.0), 200))

    assert first(0) == first(0) != first(1)
    assert 0 <= min(first(0)) < 1 and 19 < max(first(0)) <= 20


def test_a_kill_reaches_sessions_of_their_own():
    child = "import subprocess, sys; p = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(60)'], start_new_session=True); print(p.pid, flush=True); p.wait()"
    process = subprocess.Popen([sys.executable, "-c", child], stdout=subprocess.PIPE, text=True)
    pid = int(process.stdout.readline())
    assert kill_and_resume.descendants(process.pid) == [pid]
    started = time.monotonic()
    kill_and_resume.kill(process)
    assert not kill_and_resume.alive(pid) and not kill_and_resume.alive(process.pid)
    assert time.monotonic() - started < 10
    process.stdout.close()


def test_stage_is_read_from_the_record(tmp_path):
    assert kill_and_resume.stage(tmp_path) == kill_and_resume.BEFORE
    stages = {}
    for expected in ("before D-REX", "D-REX", "after D-REX", "PD-MORL"):
        (tmp_path / "stages.json").write_text(json.dumps({"stages": stages}))
        assert kill_and_resume.stage(tmp_path) == expected
        stages = {
            "before D-REX": {"D-REX": {}},
            "D-REX": {"D-REX": {"seconds": 1.0}},
            "after D-REX": {"D-REX": {"seconds": 1.0}, "PD-MORL": {}},
        }.get(expected, {})


def test_rows_and_summary_tell_what_differs():
    good = Run(hits=["D-REX", "PD-MORL", "D-REX", kill_and_resume.BEFORE], again=1)
    assert good.row(1) == "| 1 | 4 | D-REX 2x, PD-MORL, before the record | 3 | 1 | yes |"
    bad = Run(hits=["MO-PPO"], differing=["x: weight"])
    assert bad.row(2) == "| 2 | 1 | MO-PPO | 1 | 0 | no: x: weight |"
    assert not Run(error="exit code 2").good
    line = kill_and_resume.summary([good, bad], 12.3)
    assert line == (
        "5 kills in 2 runs of 12 s: 4 resumed, 1 started again, 1 of 2 runs equal to the undisturbed one"
    )


@pytest.mark.parametrize("arguments", [["--kills", "0"], ["--seed", "-1"], ["--per-run", "x"]])
def test_a_mistake_is_one_line(arguments, capsys):
    with pytest.raises(SystemExit) as stop:
        kill_and_resume.main(arguments)
    assert stop.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("kill_and_resume: error: argument ")


@pytest.mark.slow
def test_two_kills_change_nothing(capsys):
    with pytest.raises(SystemExit) as stop:
        kill_and_resume.main(["--kills", "2", "--seed", "1"])
    output = capsys.readouterr().out
    assert stop.value.code == 0, output
    assert output.splitlines()[-1].startswith("2 kills in ")
