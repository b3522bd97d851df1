"""Stages: children that end with their parent."""

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
from recipes.record import lock
from recipes.stages import run

ROOT = Path(recipes.__file__).parents[1]
# A stage that says who it is, and what it is told.
STAGE = """
import os, signal, sys, time
def told(number, frame):
    open(sys.argv[1] + ".told", "a").write(f"{number} ")
    sys.exit(5)
signal.signal(signal.SIGINT, told)
signal.signal(signal.SIGTERM, told)
open(sys.argv[1] + ".part", "w").write(f"{os.getpid()} {os.getsid(0)}")
os.rename(sys.argv[1] + ".part", sys.argv[1])
time.sleep(60)
"""
PARENT = "import sys; from recipes.stages import run; run('it', ['stage', sys.argv[1]])"


@pytest.fixture
def parent(tmp_path):
    """A process with a stage, and the ids of both."""
    (tmp_path / "stage.py").write_text(STAGE)
    note = tmp_path / "note"
    path = os.pathsep.join([str(tmp_path), str(ROOT), os.environ.get("PYTHONPATH", "")])
    process = subprocess.Popen(
        [sys.executable, "-c", PARENT, str(note)],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": path},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert eventually(note.exists)
    stage, session = map(int, note.read_text().split())
    assert session == stage != process.pid
    yield process, stage, tmp_path / "note.told"
    process.kill()
    process.communicate()


def eventually(condition: Callable[[], bool], seconds: float = 60) -> bool:
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        time.sleep(0.02)
    return condition()


def ended(process_id: int) -> bool:
    try:
        state = Path(f"/proc/{process_id}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except FileNotFoundError:
        return True
    return state == "Z"


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_stage_is_told_to_stop_and_waited_for(parent, number, code):
    process, stage, told = parent
    process.send_signal(number)
    process.communicate(timeout=60)
    assert process.returncode == code
    assert told.read_text() == f"{int(number)} "
    assert ended(stage)


@pytest.mark.skipif(sys.platform != "linux", reason="prctl is Linux's")
def test_a_stage_ends_when_its_parent_is_killed(parent):
    process, stage, told = parent
    process.kill()
    assert eventually(lambda: ended(stage))
    assert told.read_text() == f"{int(signal.SIGTERM)} "


@pytest.mark.skipif(sys.platform != "linux", reason="prctl is Linux's")
def test_a_stage_that_saves_keeps_the_lock_of_a_parent_that_was_killed(tmp_path):
    """A second training in the folder would write beside it."""
    (tmp_path / "stage.py").write_text(
        "import os, signal, sys, time\n"
        "def told(number, frame):\n"
        "    while not os.path.exists('saved'): time.sleep(0.02)\n"
        "    sys.exit(5)\n"
        "signal.signal(signal.SIGTERM, told)\n"
        "open('begun', 'w').close()\n"
        "time.sleep(60)\n"
    )
    code = "from pathlib import Path; from recipes.record import lock; from recipes.stages import run\n"
    code += "with lock(Path('.')): run('it', ['stage'])"
    path = os.pathsep.join([str(tmp_path), str(ROOT), os.environ.get("PYTHONPATH", "")])
    environ = {**os.environ, "PYTHONPATH": path}
    parent = subprocess.Popen([sys.executable, "-c", code], cwd=tmp_path, env=environ)
    try:
        assert eventually((tmp_path / "begun").exists)
        parent.kill()
        parent.wait()
        assert lock(tmp_path) is None
    finally:
        parent.kill()
        (tmp_path / "saved").touch()

    def free() -> bool:
        held = lock(tmp_path)
        return held is not None and held.close() is None

    assert eventually(free)


def test_a_stage_that_fails_is_named():
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    with pytest.raises(SystemExit, match=r"D-REX failed with exit code 2; see above\."):
        run("D-REX", ["json.tool", "--no-such-option"])
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before


def test_a_stage_is_shown_as_a_shell_takes_it(capfd):
    assert run("it", ["timeit", "-n1", "-r1", "1 + 1"]) > 0
    assert "--- it: python -m timeit -n1 -r1 '1 + 1'" in capfd.readouterr().out
