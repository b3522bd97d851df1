"""Where a command writes: new files and folders, looked at before any work is done."""

from __future__ import annotations

import itertools
import tempfile
from pathlib import Path


def check_new_file(path: Path) -> None:
    """Whether a file can be made there.

    Raises:
        ValueError: if there is something, or if its folder cannot be written.
    """
    if path.exists() or path.is_symlink():
        raise ValueError(f"--output {path} exists and is not overwritten: choose another name.")
    check_writable(path.parent, path)


def choose_file(path: Path | None, default: Path) -> Path:
    """Where a file can be made.

    Args:
        path: where the user wants it.
        default: without such a wish, with ``-2``, ``-3`` and so on at its end if it exists.

    Raises:
        ValueError: for a ``path`` that exists, or a folder that cannot be written.
    """
    if path is None:
        numbered = (default.with_stem(f"{default.stem}-{n}") for n in itertools.count(2))
        names = itertools.chain([default], numbered)
        path = next(one for one in names if not (one.exists() or one.is_symlink()))
    check_new_file(path)
    return path


def claim_folder(path: Path | None, default: Path) -> Path:
    """Make the folder for the output, which is empty.

    Args:
        path: where the user wants it; a folder that is there must be empty.
        default: without such a wish. If it exists, ``default-2`` is made, or ``default-3`` and so
            on: two demos at the same time get two folders.

    Raises:
        ValueError: if ``path`` holds something or is a file, or if the folder cannot be written.
    """
    if path is not None:
        if path.is_symlink() and not path.exists():
            raise ValueError(f"--output {path} is a link to nothing: choose another folder.")
        if path.exists() and not path.is_dir():
            raise ValueError(f"--output {path} is a file: choose a folder.")
        check_writable(path, path)
        if path.is_dir() and any(path.iterdir()):
            raise ValueError(
                f"--output {path} is not empty, and nothing is overwritten: choose another folder."
            )
        path.mkdir(parents=True, exist_ok=True)
        return path
    check_writable(default.parent, default)
    default.parent.mkdir(parents=True, exist_ok=True)
    for number in itertools.count(1):
        folder = default if number == 1 else default.with_name(f"{default.name}-{number}")
        try:
            folder.mkdir()
        except FileExistsError:
            continue
        return folder
    raise AssertionError


def check_writable(folder: Path, output: Path) -> None:
    """Whether files can be made in a folder, which may have to be made itself.

    Raises:
        ValueError: if not; it calls ``output`` what the user has asked for.
    """
    there = next(parent for parent in (folder, *folder.absolute().parents) if parent.exists())
    if not there.is_dir():
        raise ValueError(f"--output {output}: {there} is not a folder: choose another place.")
    try:
        # Permissions alone do not tell: nothing binds root, and a file system may be read-only.
        with tempfile.TemporaryFile(dir=there):
            pass
    except OSError as error:
        raise ValueError(
            f"--output {output}: {there} cannot be written ({error.strerror}): choose another place."
        ) from error
