"""Recipes as a user runs and stops them: processes, on settings that take seconds."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

import recipes

ROOT = Path(recipes.__file__).parents[1]
TINY = (
    "collector.total_frames=96_000",
    "collector.init_random_frames=96",
    "evaluation.interval=960",
    "evaluation.episodes=2",
    "replay_buffer.batch_size=16",
    "replay_buffer.size=960",
    "network.num_cells=[16,16]",
    "logger.backends=[]",
    "env.max_episode_steps=5",
    "optim.updates_per_batch=2",
)


def start(module: str, *arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", module, *arguments],
        cwd=ROOT,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def eventually(condition: Callable[[], bool], seconds: float = 120) -> bool:
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        time.sleep(0.05)
    return condition()


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_training_that_is_stopped_says_so_in_its_last_line(number, code, tmp_path):
    folder = tmp_path / "a run"
    process = start("recipes.scalarized.td3", *TINY, f"hydra.run.dir={folder}")
    assert eventually((folder / "policies").exists)  # the loop has begun
    process.send_signal(number)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == code
    assert "Traceback" not in errors
    last = errors.splitlines()[-1]
    assert last.startswith("stopped after ") and " steps; " in last and "a run" in last


def test_several_at_once_have_a_folder_each(tmp_path):
    processes = [
        subprocess.Popen(
            [
                *(sys.executable, "-m", "recipes.scalarized.td3", *TINY, f"seed={seed}"),
                *("collector.total_frames=192", "evaluation.interval=96"),
            ],
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": f"{ROOT}:{os.environ.get('PYTHONPATH', '')}"},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        for seed in range(2)
    ]
    assert [process.wait(timeout=240) for process in processes] == [0, 0]
    configs = sorted((tmp_path / "runs" / "td3_pr").glob("*/.hydra/overrides.yaml"))
    assert len(configs) == 2
    seeds = {line for path in configs for line in path.read_text().split() if "seed=" in line}
    assert seeds == {"seed=0", "seed=1"}


@pytest.mark.parametrize(
    "module",
    [
        "recipes.pd_morl.pd_morl",
        "recipes.mo_ppo.mo_ppo",
        "recipes.drex.drex",
        "recipes.scalarized.sac",
    ],
)
def test_a_mistake_is_one_line_from_a_shell(module, tmp_path):
    process = start(module, "seed=-1", f"hydra.run.dir={tmp_path / 'run'}")
    output, errors = process.communicate(timeout=120)
    assert process.returncode == 2
    assert output == ""
    (line,) = errors.splitlines()
    assert line.startswith("error: ") and ("seed must be" in line or "policy must be given" in line)
    assert list(tmp_path.iterdir()) == []


def test_ctrl_c_while_a_command_still_imports_is_one_line():
    # Where the tests run in the background of a script, Ctrl-C is ignored, and children inherit that.
    code = "import os, signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
    code += "os.kill(os.getpid(), signal.SIGINT)"
    # What `python -m` does while it looks for the module, then Ctrl-C.
    program = f"import sys; sys.argv = ['-m']; import recipes; sys.argv = ['x']; {code}"
    result = subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, timeout=60
    )
    assert result.returncode in (-signal.SIGINT, 130)
    assert result.stderr == "\ninterrupted\n"
