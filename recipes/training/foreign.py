"""What a folder may hold in which a command goes on: it writes and removes there, and somebody else may have made it."""

from __future__ import annotations

import os
import stat
from pathlib import Path


def refuse_foreign(folder: Path) -> None:
    """Refuse what leads out of a folder, and what is no file.

    Behind a link, a training that goes on would write and remove files elsewhere. A pipe would hold
    it up for good. Links within the folder, as some loggers make them, are left alone.

    Args:
        folder: that a command goes on in; it may be a link itself.

    Raises:
        ValueError: in one line, for the first of them.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as parent:
        ...     (Path(parent) / "checkpoints").symlink_to("/")
        ...     refuse_foreign(Path(parent))
        Traceback (most recent call last):
        ...
        ValueError: .../checkpoints is a link out of the folder, to /: ...
    """
    inside = folder.resolve()
    for parent, folders, files in os.walk(inside):
        for path in (Path(parent, name) for name in sorted((*folders, *files))):
            mode = path.lstat().st_mode
            if stat.S_ISLNK(mode):
                _refuse_link(path, inside)
            elif stat.S_ISFIFO(mode) or stat.S_ISCHR(mode) or stat.S_ISBLK(mode):
                raise ValueError(f"{path} is a pipe or a device, where a run has files: remove it.")


def _refuse_link(path: Path, inside: Path) -> None:
    target = os.readlink(path)
    try:
        leads_out = not path.resolve().is_relative_to(inside)
    except (OSError, RuntimeError):  # a loop of links
        leads_out = True
    if leads_out:
        raise ValueError(
            f"{path} is a link out of the folder, to {target}: what goes on here would write there; "
            "put a copy in its place."
        )
