"""The page as it is built, and a browser that opens it."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from recipes.page.contents import SCENES, SHIPPED, contents
from recipes.page.html import html


@pytest.fixture(scope="session")
def page_file(tmp_path_factory) -> Path:
    """The page that ``python -m recipes.page`` writes, with fewer scenes."""
    file = tmp_path_factory.mktemp("page") / "index.html"
    file.write_text(html(contents(SHIPPED, SCENES, num_scenes=5)))
    return file


@pytest.fixture(scope="session")
def browser() -> Iterator:
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    binary = shutil.which("chromium") or shutil.which("chromium-browser")
    with playwright.sync_playwright() as running:
        if binary is None and not Path(running.chromium.executable_path).exists():
            pytest.skip(
                "there is no Chromium: apt-get install chromium, or playwright install chromium"
            )
        # Processes of root, as in containers, have no sandbox.
        open_browser = running.chromium.launch(executable_path=binary, args=["--no-sandbox"])
        yield open_browser
        open_browser.close()
