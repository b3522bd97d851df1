"""The run folder of a training: claimed by one run alone, and what made it."""

from __future__ import annotations

import contextlib
import fcntl
import importlib.metadata
import itertools
import json
import math
import os
import platform
import shutil
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any


def claim(base: Path) -> Path:
    """Make a new folder ``base/<date>_<time>``, which no other process gets.

    Of two that ask in the same second one gets ``-2`` at its end, and so on.

    Raises:
        OSError: if it cannot be made.

    Examples:
        >>> import tempfile
        >>> base = Path(tempfile.mkdtemp())
        >>> claim(base) == claim(base)
        False
    """
    base.mkdir(parents=True, exist_ok=True)
    while True:
        folder = free_name(base)
        try:
            folder.mkdir()
        except FileExistsError:
            continue  # somebody else was quicker
        return folder


def free_name(base: Path) -> Path:
    """The folder that :func:`claim` would make now."""
    name = time.strftime("%Y-%m-%d_%H-%M-%S")
    numbered = (f"{name}-{number}" for number in itertools.count(2))
    return next(
        base / one for one in itertools.chain([name], numbered) if not (base / one).exists()
    )


def check_new(folder: Path, option: str = "hydra.run.dir") -> None:
    """Refuse a folder that holds something.

    Raises:
        FileExistsError: if it does, or if it is a file.
    """
    if folder.is_dir():
        policies = folder / "policies"
        found = policies if policies.exists() else next(iter(sorted(folder.iterdir())), None)
    else:
        found = folder if folder.exists() else None
    if found is not None:
        raise FileExistsError(f"{found} exists and is not overwritten: choose another {option}.")


def check_run_dir(run_dir: Path) -> None:
    """Refuse a folder that another training has left policies in, before hours of training."""
    policies = run_dir / "policies"
    if policies.exists():
        raise FileExistsError(
            f"{policies} exists and is not overwritten: choose another hydra.run.dir."
        )


@contextlib.contextmanager
def held(run_dir: Path) -> Iterator[None]:
    """Keep other processes from training in a folder while the block runs.

    A lock of the folder itself, which ends with the process: it leaves nothing behind.

    Raises:
        ValueError: if another process holds it.
    """
    folder = os.open(run_dir, os.O_RDONLY)
    try:
        try:
            fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ValueError(
                f"{run_dir} is being trained by another process: wait until it ends, or stop it."
            ) from None
        except OSError:
            pass  # a network's file system that has no locks of folders
        yield
    finally:
        os.close(folder)


def remove_if_refused(run_dir: Path, *, keep: bool = False) -> None:
    """Remove a folder that holds nothing but what Hydra writes before a recipe begins.

    Args:
        run_dir: the folder.

    Keyword Args:
        keep: the folder itself, which was there before.
    """
    if run_dir.is_dir() and {entry.name for entry in run_dir.iterdir()} <= {".hydra"}:
        shutil.rmtree(run_dir / ".hydra", ignore_errors=True)
        if not keep:
            run_dir.rmdir()


def missing(folder: Path) -> list[Path]:
    """The folder and those above it, as far as they are not there."""
    return [path for path in (folder, *folder.parents) if not path.exists()]


def remove_empty(folders: Iterable[Path]) -> None:
    """Remove folders that are empty, the innermost first."""
    for path in folders:
        with contextlib.suppress(OSError):  # it holds something, or is not there
            path.rmdir()


def write_atomically(path: Path, text: str) -> None:
    """Write a file that is there whole or not at all, whenever the process ends.

    Raises:
        OSError: if it cannot be written; what was there before is untouched.
    """
    part = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with part.open("w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def is_over(run_dir: Path) -> bool:
    """Whether a training has made the last thing that it makes: a reward model, or its last checkpoint.

    A checkpoint is there whole or not at all, and is the last thing that a step writes.
    """
    if (run_dir / "reward_model").is_dir():
        return True
    config = run_dir / ".hydra" / "config.yaml"
    saved = [
        int(path.name.rpartition("-")[2])
        for path in (run_dir / "checkpoints").glob("checkpoint-*")
        if path.name.rpartition("-")[2].isdecimal()
    ]
    if not saved or not config.is_file():
        return False
    import yaml  # the stages alone need it

    try:
        total = yaml.safe_load(config.read_text(encoding="utf-8"))["collector"]["total_frames"]
        return max(saved) >= total
    except (yaml.YAMLError, ValueError, LookupError, TypeError, RecursionError):
        return False  # its recipe says what is wrong with it


def write_run_info(run_dir: Path) -> None:
    """Versions and git state, beside the resolved configuration that Hydra writes.

    ``run.json`` keeps what it holds: a start in a folder that has one is added to its list ``resumed``.

    Raises:
        ValueError: if it holds something else.
    """
    path = run_dir / "run.json"
    if path.exists():
        try:
            info = json.loads(path.read_text())
            resumed = info.setdefault("resumed", [])
            count = len(resumed)
        except (ValueError, AttributeError, TypeError, RecursionError) as error:
            raise ValueError(f"{path} was not written by a run: {error}") from error
        resumed.append(_start(run_dir, f"uncommitted_{count + 2}.diff"))
    else:
        info = _start(run_dir, "uncommitted.diff")
    write_atomically(path, json.dumps(info, indent=2) + "\n")


def _start(run_dir: Path, diff: str) -> dict[str, Any]:
    packages = ("torch", "torchrl", "tensordict", "mujoco", "gymnasium", "mo-gymnasium", "numpy")
    return {
        "started": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        "python": platform.python_version(),
        "versions": {name: importlib.metadata.version(name) for name in packages},
        "git": _git_state(run_dir / diff),
    }


def _git_state(diff_file: Path) -> dict[str, Any] | None:
    if shutil.which("git") is None:
        return None

    def git(*arguments: str) -> subprocess.CompletedProcess:
        where = Path(__file__).parent
        return subprocess.run(
            ["git", *arguments], cwd=where, capture_output=True, text=True, errors="replace"
        )

    commit = git("rev-parse", "HEAD")
    if commit.returncode:
        return None
    diff = git("diff", "HEAD").stdout
    if diff:
        write_atomically(diff_file, diff)
    return {"commit": commit.stdout.strip(), "uncommitted_changes": bool(diff)}


def score(policy: Path) -> float:
    """What the evaluation that saved a policy gave it.

    Raises:
        ValueError: if its card does not say.
    """
    file = policy / "policy.json"
    try:
        value = float(json.loads(file.read_text(encoding="utf-8"))["card"]["score"])
    except (OSError, ValueError, LookupError, TypeError, RecursionError) as error:
        raise ValueError(f"{file} does not say the score of the policy: {error}.") from error
    # Neither is JSON, and NaN is neither the best nor not.
    if not math.isfinite(value):
        raise ValueError(f"{file} does not say the score of the policy: it says {value}.")
    return value


def final_policy(run_dir: Path) -> Path:
    """The policy with the best score among those saved in the last fifth of the training."""
    policies = _saved(run_dir)
    late = policies[-max(1, len(policies) // 5) :]
    return max(late, key=score)


def last_policy(run_dir: Path) -> Path:
    """The policy at the end of the training, as the paper takes it."""
    return _saved(run_dir)[-1]


def _saved(run_dir: Path) -> list[Path]:
    policies = sorted((run_dir / "policies").glob("[!.]*"))
    if not policies:
        sys.exit(
            f"{run_dir / 'policies'} holds no policy: the training ended before its first update. "
            "Raise collector.total_frames."
        )
    return policies
