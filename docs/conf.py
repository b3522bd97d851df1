"""The site: ``make docs`` writes it to ``docs/_build/html``. A warning is an error."""

from __future__ import annotations

import os
import re
from pathlib import Path

from docutils import nodes
from docutils.utils.math import latex2mathml
from sphinx.application import Sphinx
from sphinx.writers.html5 import HTML5Translator

import torchrl_morl
from recipes.page.contents import SCENES, SHIPPED, contents
from recipes.page.html import html

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent

project = "torchrl-morl"
author = copyright = "The torchrl-morl contributors"
version = release = torchrl_morl.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = f"torchrl-morl {version}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False

html_math_renderer = "mathml"

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4  # as GitHub makes them

autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented_params"
napoleon_use_rtype = False

# A role that names something of ours must lead to it. Other projects' references are not read: a build
# needs no network. Types in signatures are not always public.
nitpicky = True
nitpick_ignore_regex = [
    (r"py:.*", r"(?!(torchrl_morl|envs|recipes)\.).*"),
    (r"py:class", r".*\._\w+"),
]

ELSEWHERE = {
    "README.md": "index.md",
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "benchmarks/README.md": "benchmarks.md",
}
"""Pages outside of this folder, and where the site has them."""


PLAY = "play.html"
"""Where the site has the page to play with."""


def setup(app: Sphinx) -> None:
    """Links of the pages hold on GitHub, on the site some files are elsewhere; equations need no script."""
    app.connect("source-read", _read)
    app.connect("build-finished", _build_play)
    app.add_html_math_renderer("mathml", (_equation, None), (_equation, None))


def _equation(translator: HTML5Translator, node: nodes.Element) -> None:
    """An equation in MathML, which browsers render themselves: pages work without a network, too."""
    text = re.sub(r"\\[Bb]igg?[lr]?(?![a-zA-Z])", "", node.astext()).replace(r"\dots", r"\ldots")
    if "&" in text or r"\\" in text:
        text = rf"\begin{{aligned}}{text}\end{{aligned}}"
    block = isinstance(node, nodes.math_block)
    mathml = latex2mathml.tex2mathml(text, as_block=block)
    translator.body.append(f'<div class="math">{mathml}</div>' if block else mathml)
    raise nodes.SkipNode


def _read(app: Sphinx, docname: str, source: list[str]) -> None:
    page = DOCS / f"{docname}.md"
    for outside, inside in ELSEWHERE.items():
        if docname != "index" and page == DOCS / inside:
            source[0] = _moved((ROOT / outside).read_text(), ROOT / outside, page)
            return
    source[0] = _moved(source[0], page, page).replace(
        "<!-- play -->",
        f'<a href="{os.path.relpath(DOCS / PLAY, page.parent)}">Play with it here.</a>',
    )


def _build_play(app: Sphinx, exception: Exception | None) -> None:
    if exception is None and app.builder.format == "html":
        (Path(app.outdir) / PLAY).write_text(html(contents(SHIPPED, SCENES)))


def _moved(text: str, source: Path, page: Path) -> str:
    """The text of a file, with its links as they are on a page of the site."""

    def move(match: re.Match[str]) -> str:
        target, _, anchor = match[2].partition("#")
        if not target or re.match(r"[a-z]+:", target):
            return match[0]
        path = (source.parent / target).resolve()
        if ROOT in path.parents:
            moved = ELSEWHERE.get(str(path.relative_to(ROOT)))
            path = DOCS / moved if moved else path
        link = os.path.relpath(path, page.parent)
        return f"]({link}{'#' if anchor else ''}{anchor})"

    return re.sub(r"(\])\(([^()\s]+)\)", move, text)
