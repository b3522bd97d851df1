"""Commands that take turns: each a child that ends with its parent, and is recorded when it is finished."""

from __future__ import annotations

import contextlib
import ctypes
import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from recipes.record import Record
from recipes.training.quoting import is_of_hydra, quoted
from recipes.training.run_folder import is_over, remove_if_refused
from recipes.training.stopping import IS_STAGE, stop_signals

_PR_SET_PDEATHSIG = 1


def refuse_places(option: str, overrides: Sequence[str]) -> None:
    """Refuse overrides of a stage that say where it runs: the whole has one place.

    Those of Hydra itself are refused as well: it makes objects of whatever class it is told, and
    what goes on reads the overrides from a folder.

    Raises:
        ValueError: in one line.
    """
    for one in overrides:
        if one.lstrip("+~").startswith(("hydra.run", "hydra.sweep", "resume=")):
            raise ValueError(
                f"{option} {one}: the stages run in the folder of --output, leave it out."
            )
        if is_of_hydra(one):
            raise ValueError(f"{option} {one}: a stage takes fields of its own, not Hydra's.")


def preset(overrides: Sequence[str], name: str) -> list[str]:
    """A preset of a stage, unless the user chose another one: Hydra takes one."""
    chosen = any(one.startswith("preset=") for one in overrides)
    return [] if chosen else [f"preset={name}"]


def run(name: str, command: Sequence[str]) -> float:
    """Run ``python -m command`` as a stage and return its wall time in seconds.

    Ctrl-C and SIGTERM go on to the stage, which saves what it has; if this process is killed, the
    stage gets SIGTERM, and holds a :func:`~recipes.record.lock` of this process until it has saved.

    Raises:
        SystemExit: if the stage fails, or after it has been asked to stop: with 130 or 143.
    """
    print(f"--- {name}: {shlex.join(['python', '-m', *command])}", flush=True)
    started = time.perf_counter()
    parent = os.getpid()
    libc = ctypes.CDLL(None) if sys.platform == "linux" else None

    def end_with_parent() -> None:
        if libc is not None:
            libc.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
        if os.getppid() != parent:  # it ended before it was told so
            os._exit(128 + signal.SIGTERM)

    # In a session of its own: Ctrl-C of a terminal reaches it once, through us.
    child = subprocess.Popen(
        [sys.executable, "-m", *command],
        stdin=subprocess.DEVNULL,
        start_new_session=True,
        preexec_fn=end_with_parent,
        env={**os.environ, IS_STAGE: "1"},
        close_fds=False,  # Python's own files close all the same, but for those of a lock
    )
    asked: list[int] = []

    def forward(number: int, frame: object) -> None:
        asked.append(number)
        child.send_signal(number)

    with stop_signals(forward):
        code = child.wait()
    if asked:
        raise SystemExit(128 + asked[0])
    if code:
        sys.exit(f"{name} failed with exit code {code}; see above.")
    return time.perf_counter() - started


@contextlib.contextmanager
def says_how_to_go_on(record: Record, module: str) -> Iterator[None]:
    """One line about what stops or fails in the block, which ends the command."""
    go_on = f"go on with: python -m {module} --resume {shlex.quote(str(record.folder))}"
    try:
        yield
    except KeyboardInterrupt:
        print(f"stopped; {go_on}", file=sys.stderr)
        sys.exit(128 + signal.SIGINT)
    except SystemExit as stop:
        if isinstance(stop.code, str):
            sys.exit(f"{stop.code} When that is put right {go_on}")
        print(f"stopped; {go_on}", file=sys.stderr)
        raise
    except (OSError, ValueError) as error:  # a folder that somebody has changed, a full disk
        sys.exit(f"error: {' '.join(str(error).split())} When that is put right {go_on}")


def stage(
    record: Record, name: str, folder_name: str, command: Callable[[Path], list[str]]
) -> Path:
    """Run a stage, unless it is finished; go on with it, if it has begun. Returns its folder.

    Args:
        record: of the whole.
        name: of the stage.
        folder_name: beside the record.
        command: that runs it in a folder.
    """
    before = record.folder_of(name)
    if before is not None and record.is_finished(name):
        return before
    folder = record.folder / folder_name
    # It may have been killed before it had made anything, or between its end and the record of that.
    remove_if_refused(folder)
    if before is not None and is_over(folder):
        record.finish(name, 0.0)
        return folder
    if (folder / ".hydra" / "overrides.yaml").is_file():
        # It was cut short: it goes on in its folder, as it was configured.
        given = [command(folder)[0], f"resume={quoted(folder)}"]
    else:
        given = command(folder)
    record.begin(name, given, folder.name)
    record.finish(name, run(name, given))
    return folder
