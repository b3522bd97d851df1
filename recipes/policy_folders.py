"""Folders of policies: a wrong one is refused in one line that says which there are near it.

::

    parser.add_argument("--policy", type=policy_folder, default=SHIPPED_POLICY)
"""

from __future__ import annotations

import argparse
import contextlib
import difflib
import itertools
from pathlib import Path

from envs.fields import shown

from .arguments import some_path

FILES = ("policy.safetensors", "policy.json")
"""What a folder of a policy holds."""

SHIPPED = Path(__file__).parent / "policies"

_MOST_NAMES = 30
_MOST_LOOKED_AT = 10_000


def policy_folder(text: str) -> Path:
    """A type for :mod:`argparse`: a folder that holds a policy.

    Raises:
        argparse.ArgumentTypeError: for any other path; the message names policies near it.
    """
    path = some_path(text)
    if why := no_policy(path):
        raise argparse.ArgumentTypeError(why)
    return path


def no_policy(folder: Path) -> str | None:
    """Why a folder holds no policy, and where there are some; ``None`` if it holds one.

    Examples:
        >>> from pathlib import Path
        >>> no_policy(SHIPPED / "navigation")
        >>> no_policy(SHIPPED / "navigatoin").rpartition(": ")[2]
        'did you mean navigation?'
    """
    missing = next((file for file in FILES if not _is_file(folder / file)), None)
    if missing is None:
        return None
    what = f"{folder / missing} not found: a policy is a folder with {' and '.join(FILES)}"
    if _holds_policy(folder.parent):
        return f"{what}; did you mean {_shown(folder.parent)}?"
    place = next((one for one in (folder, *folder.parents) if _is_folder(one)), Path())
    near = _policies_below(place)
    if not near and place != Path():  # all runs that there are would be no help
        near = _policies_below(place, "*/*")
    if not near:
        place, near = SHIPPED, _policies_below(SHIPPED)
    names = [str(path.relative_to(place)) for path in near]
    listed = ", ".join(map(shown_name, names[:_MOST_NAMES]))
    if len(names) > _MOST_NAMES:
        listed += f" and {len(names) - _MOST_NAMES} more"
    like = _like(folder, near)
    guess = f": did you mean {shown_name(str(like.relative_to(place)))}?" if like else ""
    return f"{what}; {_shown(place)} has {listed}{guess}" if names else what


def shown_name(name: str) -> str:
    """A name of a folder, which may hold anything, in one line."""
    return name if name.isprintable() else shown(name)


def _policies_below(place: Path, pattern: str = "*") -> list[Path]:
    """Folders with a policy in a folder."""
    try:
        files = itertools.islice(place.glob(f"{pattern}/{FILES[1]}"), _MOST_LOOKED_AT)
        return sorted(one.parent for one in files if _holds_policy(one.parent))
    except OSError:
        return []


def _like(folder: Path, near: list[Path]) -> Path | None:
    """The one whose name is most like the last part of a path."""
    close = difflib.get_close_matches(folder.name, [path.name for path in near], n=1)
    return next((path for path in near if path.name == close[0]), None) if close else None


def _holds_policy(folder: Path) -> bool:
    return all(_is_file(folder / file) for file in FILES)


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:
        return False


def _is_folder(path: Path) -> bool:
    try:
        return path.is_dir()
    except OSError:
        return False


def _shown(path: Path) -> str:
    """Relative to where the user is, if it lies below."""
    with contextlib.suppress(OSError, ValueError):
        path = path.resolve().relative_to(Path.cwd())
    return shown_name(str(path))
