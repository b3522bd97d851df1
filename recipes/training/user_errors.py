"""From what a command raises to the one line that its user reads, and the exit code."""

from __future__ import annotations

import errno
import os
import shutil
from pathlib import Path

from hydra.errors import HydraException, OverrideParseException
from omegaconf.errors import OmegaConfBaseException
from safetensors import SafetensorError

from . import stopping
from .validation import ConfigurationError

REFUSED, FAILED = 2, 1
"""Exit codes: the command was wrong; what it needs has failed while it ran."""

_WRITE_FAILED = ("No space left on device", "PytorchStreamWriter failed", "os error 28")


def error_line(
    error: BaseException, run_dir: Path | None, *, go_on: str | None = None
) -> tuple[str | None, int]:
    """What to print for an error, and the exit code; no line for what is our own mistake.

    Args:
        error: that ended the command.
        run_dir: of the run, if there is one.

    Keyword Args:
        go_on: the command that goes on where this one was, if there is one.
    """
    begun = stopping.has_begun() or (run_dir is not None and _holds_more_than_hydra(run_dir))
    # Where nothing has been done there is nothing to go on with.
    further = f"; go on with: {go_on}" if go_on and begun else ""
    kept = further or (f"; what is saved is in {run_dir}" if begun else "")
    if isinstance(error, stopping.Stopped):
        return f"stopped {error.done}{kept}", stopping.exit_code()
    if isinstance(error, KeyboardInterrupt):
        done = "ended at once" if begun else "stopped before anything was done"
        return f"{done}{kept}", stopping.exit_code()
    if isinstance(error, HydraException | OmegaConfBaseException):
        return _hydra_line(error), REFUSED
    if isinstance(error, ConfigurationError):
        return _one_line(error), REFUSED
    if _disk_is_full(error, run_dir):
        return _joined(_full_disk_line(error, run_dir), further), FAILED
    if isinstance(error, OSError):
        line = _joined(_os_line(error, run_dir, begun=begun), further)
        return line, FAILED if begun else REFUSED
    if isinstance(error, ValueError | ImportError):
        hint = "; --debug shows where" if begun else ""
        return _joined(_one_line(error), hint + further), FAILED if begun else REFUSED
    return None, FAILED


def _holds_more_than_hydra(run_dir: Path) -> bool:
    try:
        return any(entry.name != ".hydra" for entry in run_dir.iterdir())
    except (FileNotFoundError, NotADirectoryError):
        return False


def _hydra_line(error: Exception) -> str:
    if isinstance(error, OverrideParseException):
        what = error.message.splitlines()[0]
        return (
            f"{error.override} cannot be read: {what}; put text with special characters in quotes."
        )
    lines = [line.strip() for line in str(error).splitlines()]
    if field := getattr(error, "full_key", None):
        lines[0] = f"{field}: {lines[0]}"
    end = next(
        (i for i, line in enumerate(lines) if line.startswith(("Config search", "full_key"))), None
    )
    cause = error.__cause__
    if isinstance(cause, OmegaConfBaseException):
        lines = [*lines[:end], str(cause).splitlines()[0]]
        end = None
    return " ".join(line for line in lines[:end] if line)


def _disk_is_full(error: BaseException, run_dir: Path | None) -> bool:
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        return True
    # Rust and C++ say it in words.
    if isinstance(error, OSError | SafetensorError | RuntimeError) and run_dir is not None:
        return any(text in str(error) for text in _WRITE_FAILED)
    return False


def _full_disk_line(error: BaseException, run_dir: Path | None) -> str:
    path = getattr(error, "filename", None) or run_dir
    where = next(one for one in (Path(path), *Path(path).absolute().parents) if one.exists())
    free = shutil.disk_usage(where).free / 1e6
    what = f"{os.strerror(errno.ENOSPC)} ({free:.1f} MB are free)"
    return f"{path}: {what}: free some space, or choose another hydra.run.dir"


def _os_line(error: OSError, run_dir: Path | None, *, begun: bool) -> str:
    if error.errno is None:
        return _one_line(error)
    if isinstance(error, BrokenPipeError):
        return "nobody reads what is printed any more (broken pipe)"
    if begun and run_dir is not None and not run_dir.is_dir():
        return f"{error.filename or run_dir}: the run folder {run_dir} has vanished"
    advice = ""
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        advice = ": choose a folder that can be written, hydra.run.dir=FOLDER"
    path = error.filename or run_dir
    return f"{path}: {error.strerror}{advice}"


def _joined(line: str, more: str) -> str:
    """A sentence ends where nothing follows."""
    return line.rstrip(".") + more if more else line


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__
