"""What stands at a path where a file or a folder is needed, said in one line before anything is opened."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path


def no_file(path: str | Path) -> str | None:
    """Why it is no file that can be read; ``None`` if it is one. A pipe, which would hold up its reader, is none.

    Examples:
        >>> no_file("/dev/zero"), no_file("/")
        ('is a pipe or a device, not a file', 'is a folder, not a file')
    """
    mode, why = _mode(Path(path))
    if mode is None:
        return why
    if stat.S_ISDIR(mode):
        return "is a folder, not a file"
    if not stat.S_ISREG(mode):
        return "is a pipe or a device, not a file"
    return None if os.access(path, os.R_OK) else "cannot be read: Permission denied"


def no_folder(path: str | Path) -> str | None:
    """Why it is no folder that can be read; ``None`` if it is one."""
    mode, why = _mode(Path(path))
    if mode is None:
        return why
    if not stat.S_ISDIR(mode):
        return "is a file" if stat.S_ISREG(mode) else "is a pipe or a device"
    return None if os.access(path, os.R_OK | os.X_OK) else "cannot be read: Permission denied"


def _mode(path: Path) -> tuple[int | None, str]:
    """What kind of thing it is, or why nobody knows."""
    try:
        return path.stat().st_mode, ""
    except FileNotFoundError:
        if path.is_symlink():
            return None, f"is a link to {os.readlink(path)}, which is not there"
        from_here = "" if path.is_absolute() else f" (searched from {Path.cwd()})"
        return None, f"does not exist{from_here}"
    except NotADirectoryError:
        return None, "does not exist: what should be a folder is a file"
    except OSError as error:
        if error.errno == errno.ELOOP:
            return None, "is a loop of links"
        return None, f"cannot be read: {error.strerror}"
    except ValueError:  # a NUL
        return None, "is no path"
