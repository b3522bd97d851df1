"""The page's template, style, program and contents as one file."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from .modules import script

SOURCES = Path(__file__).resolve().parents[2] / "page"

STYLES = ("page", "floor", "panel", "choices", "small")
"""Of ``page/style``, in their order: what follows wins."""


def html(contents: Mapping[str, Any]) -> str:
    """The whole page.

    Args:
        contents: of :func:`recipes.page.contents.contents`.
    """
    # "</" would end the element that holds it. In JSON a slash may be escaped.
    data = json.dumps(contents, allow_nan=False, separators=(",", ":")).replace("</", "<\\/")
    program = script(SOURCES / "main.js")
    if "</" in program:
        raise ValueError("page/: a module holds '</', which would end the script in the page.")
    page = (SOURCES / "index.html").read_text()
    for mark, text in (
        ("/*STYLE*/", "".join((SOURCES / "style" / f"{name}.css").read_text() for name in STYLES)),
        ("/*PROGRAM*/", program),
        ("/*CONTENTS*/", data),
    ):
        before, found, after = page.partition(mark)
        assert found, mark
        page = before + text + after
    return page
