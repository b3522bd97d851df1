"""The page as it is built, and a browser that opens it."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from recipes.page.choices import choices
from recipes.page.contents import SCENES, SHIPPED, contents
from recipes.page.html import html

from ._browser import SHOWCASE


@pytest.fixture(scope="session")
def page_file(tmp_path_factory) -> Path:
    """The page that ``python -m recipes.page`` writes, with fewer scenes."""
    file = tmp_path_factory.mktemp("page") / "index.html"
    held = contents(SHIPPED, SCENES, num_scenes=5)
    file.write_text(html({**held, "choices": choices(SHIPPED[0])}))
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


@pytest.fixture
def opened(browser, page_file):
    """A function that opens the page, with a link's part behind ``#``; afterwards nothing has gone wrong."""
    contexts, wrong, asked = [], [], []

    def open_page(link: str = SHOWCASE, width: int = 1280, height: int = 800, **kwargs):
        context = browser.new_context(viewport={"width": width, "height": height}, **kwargs)
        contexts.append(context)
        context.set_default_timeout(120_000)  # a loaded machine takes its time
        page = context.new_page()
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.on("console", lambda text: wrong.append(text.text) if text.type == "error" else None)
        page.on("request", lambda request: asked.append(request.url.split(":")[0]))
        page.goto(page_file.as_uri() + link)
        page.wait_for_function("window.page")
        page.evaluate("page.session.playing = false; page.session.restart()")
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert wrong == []
    assert set(asked) <= {"file", "blob", "data"}  # it needs nobody
