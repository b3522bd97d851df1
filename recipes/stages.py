"""Commands that take turns: each a child that ends with its parent, and a record of which are finished."""

from __future__ import annotations

import ctypes
import dataclasses
import fcntl
import json
import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

from recipes.training.run_folder import write_atomically

_PR_SET_PDEATHSIG = 1


def refuse_places(option: str, overrides: Sequence[str]) -> None:
    """Refuse overrides of a stage that say where it runs: the whole has one place.

    Raises:
        ValueError: in one line.
    """
    for one in overrides:
        if one.lstrip("+~").startswith(("hydra.run", "hydra.sweep", "resume=")):
            raise ValueError(
                f"{option} {one}: the stages run in the folder of --output, leave it out."
            )


def run(name: str, command: Sequence[str]) -> float:
    """Run ``python -m command`` as a stage and return its wall time in seconds.

    Ctrl-C and SIGTERM go on to the stage, which saves what it has; if this process is killed, the
    stage gets SIGTERM, and holds a :func:`lock` of this process until it has saved.

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
        close_fds=False,  # Python's own files close all the same, but for those of a lock
    )
    asked: list[int] = []

    def forward(number: int, frame: object) -> None:
        asked.append(number)
        child.send_signal(number)

    before = {one: signal.signal(one, forward) for one in (signal.SIGINT, signal.SIGTERM)}
    try:
        code = child.wait()
    finally:
        for one, handler in before.items():
            signal.signal(one, handler)
    if asked:
        raise SystemExit(128 + asked[0])
    if code:
        sys.exit(f"{name} failed with exit code {code}; see above.")
    return time.perf_counter() - started


@dataclasses.dataclass
class Record:
    """Which stages of a training are finished: ``stages.json`` in its folder.

    Args:
        folder: of the training.
        options: of its command.
        stages: by name, in order: ``folder`` beside this file, ``command``, and ``seconds`` once the
            stage is finished.

    Examples:
        >>> import tempfile
        >>> record = Record(Path(tempfile.mkdtemp()), {"episodes": 100})
        >>> record.begin("D-REX", ["recipes.drex.drex"], "drex")
        >>> record.is_finished("D-REX")
        False
        >>> record.finish("D-REX", 60.0)
        >>> Record.load(record.folder).is_finished("D-REX")
        True
    """

    folder: Path
    options: dict[str, Any]
    stages: dict[str, dict[str, Any]] = dataclasses.field(default_factory=dict)
    finished: bool = False

    FILE = "stages.json"

    @classmethod
    def load(cls, folder: Path) -> Record:
        """Read the record of a training.

        Raises:
            ValueError: if there is none, or if it cannot be read.
        """
        path = folder / cls.FILE
        if not path.is_file():
            raise ValueError(f"{path} not found: {folder} is no training of recipes.train.")
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            record = cls(folder, content["options"], content["stages"], content["finished"])
            if not (isinstance(record.options, dict) and isinstance(record.stages, dict)):
                raise TypeError("its entries are no mappings")
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise ValueError(f"{path} cannot be read: {error}.") from error
        return record

    def save(self) -> None:
        content = {"options": self.options, "stages": self.stages, "finished": self.finished}
        write_atomically(self.folder / self.FILE, json.dumps(content, indent=2) + "\n")

    def begin(self, name: str, command: Sequence[str], folder: str | None) -> None:
        self.stages[name] = {"folder": folder, "command": list(command)}
        self.save()

    def finish(self, name: str, seconds: float) -> None:
        self.stages[name]["seconds"] = seconds
        self.save()

    def is_finished(self, name: str) -> bool:
        return "seconds" in self.stages.get(name, {})

    def folder_of(self, name: str) -> Path | None:
        """Where a stage that has begun writes to."""
        folder = self.stages.get(name, {}).get("folder")
        return self.folder / folder if folder is not None else None


def lock(folder: Path) -> IO[str] | None:
    """Keep others from a training as long as the file is open; ``None`` if another process has it.

    Stages that :func:`run` begins have it open as well: one that outlives this process, to save what it
    has, keeps others away until it has ended.

    Raises:
        OSError: if the folder cannot be written.
    """
    file = (folder / ".lock").open("w")
    os.set_inheritable(file.fileno(), True)
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        file.close()
        return None
    return file


def is_unused(folder: Path) -> bool:
    """Whether a folder holds nothing, or only what a training leaves that was killed before its record was."""
    leftovers = (".lock", f".{Record.FILE}.")
    return folder.is_dir() and all(path.name.startswith(leftovers) for path in folder.iterdir())


def unfinished(base: Path) -> Path | None:
    """The latest training in a folder that is neither finished nor under way."""
    for path in sorted(base.glob(f"*/{Record.FILE}"), reverse=True):
        try:
            record = Record.load(path.parent)
            held = None if record.finished else lock(path.parent)
        except (ValueError, OSError):
            continue
        if held is not None:
            held.close()
            return path.parent
    return None
