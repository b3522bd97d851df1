"""The pages as tests read them: prose, blocks of code, links, anchors."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]
HISTORY = ROOT / "docs" / "history"
README = ROOT / "README.md"


class Block(NamedTuple):
    """A fenced block of code: its language and its text, without the indent of its fence."""

    language: str
    code: str


class Link(NamedTuple):
    """A link or a picture: what it shows and where it leads."""

    text: str
    target: str


_FENCE = re.compile(r"^( *)(```+)([\w{}-]*)[^\n]*\n(.*?)^\1\2 *$", re.DOTALL | re.MULTILINE)
_LINK = re.compile(r"!?\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^()\s]+(?:\([^()]*\))?)\)")


def pages(*, history: bool = True) -> list[Path]:
    """README, CHANGELOG, CONTRIBUTING, the pages of ``docs`` and of the rooms, as far as git tracks them."""
    found = [path for path in tracked() if path.suffix == ".md"]
    return [path for path in found if history or HISTORY not in path.parents]


def tracked() -> list[Path]:
    """The files of the checkout: those that git tracks, or all that it would."""
    if shutil.which("git") and (ROOT / ".git").exists():
        listing = subprocess.run(
            ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"],
            cwd=ROOT,
            capture_output=True,
            text=True,
            check=True,
        )
        paths = [ROOT / name for name in listing.stdout.split("\0") if name]
        return sorted(path for path in paths if path.is_file())
    # An unpacked archive. Folders of the user's own are not the project's.
    own = {".venv", "runs", "outputs", "_build", "__pycache__"}
    paths = [path for path in ROOT.rglob("*") if path.is_file()]
    return sorted(path for path in paths if not own & set(path.relative_to(ROOT).parts))


def name(page: Path) -> str:
    """For the ids of tests and for messages."""
    return str(page.relative_to(ROOT))


def blocks(text: str, language: str | None = None) -> list[Block]:
    """Fenced blocks, of one language if it is given."""
    found = []
    for indent, _, kind, code in _FENCE.findall(text):
        code = re.sub(rf"^{indent}", "", code, flags=re.MULTILINE)
        found.append(Block(kind, code))
    return [block for block in found if language is None or block.language == language]


def without_code(text: str) -> str:
    """The page without its blocks and without what stands between backticks."""
    return re.sub(r"`+[^`\n]*`+", "", _FENCE.sub("", text))


def prose(text: str) -> str:
    """What is read: without code blocks, tables, pictures and the targets of links."""
    lines = _FENCE.sub("", text).splitlines()
    text = "\n".join(line for line in lines if not line.lstrip().startswith("|"))
    text = re.sub(r"!\[[^\]]*\]\([^)]*\)|<!--.*?-->", "", text, flags=re.DOTALL)
    return _LINK.sub(lambda match: match[1], text)


def words(text: str) -> int:
    """How many words its prose has; a number is one, a dash is none."""
    return len(re.findall(r"[^\s]*\w[^\s]*", prose(text)))


def tables(text: str) -> int:
    """How many tables it has."""
    return len(re.findall(r"^ *\|[ :|-]+\|$", _FENCE.sub("", text), re.MULTILINE))


def links(text: str) -> Iterator[Link]:
    """Links and pictures outside of code."""
    for shown, target in _LINK.findall(without_code(text)):
        yield Link(shown, target)
        # A picture that is a link.
        yield from (Link(*inner) for inner in _LINK.findall(shown))


def anchors(text: str) -> set[str]:
    """Anchors of the headings, as GitHub makes them."""
    found: dict[str, int] = {}
    for title in re.findall(r"^#{1,6} +(.*?) *#*$", _FENCE.sub("", text), re.MULTILINE):
        title = _LINK.sub(lambda match: match[1], title)
        anchor = re.sub(r"[^\w\- ]", "", title.replace("`", "").lower()).replace(" ", "-")
        found[anchor] = found.get(anchor, -1) + 1
        if found[anchor]:
            found[f"{anchor}-{found[anchor]}"] = 0
    return set(found)


def leads_to(page: Path, target: str) -> tuple[Path, str] | None:
    """The file of the checkout and the anchor that a link names, ``None`` for one to elsewhere."""
    if re.match(r"[a-z]+:", target):
        return None
    path, _, anchor = target.partition("#")
    return (page.parent / path).resolve() if path else page, anchor
