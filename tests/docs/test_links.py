"""No link leads nowhere, and no page of the present names a commit."""

from __future__ import annotations

import re

import pytest

from ._pages import (
    HISTORY,
    README,
    ROOT,
    anchors,
    leads_to,
    links,
    name,
    pages,
    tracked,
    without_code,
)

PAGES = pages()
COMMIT = re.compile(r"(?<![\w/.-])(?=[0-9a-f]*\d)(?=[0-9a-f]*[a-f])[0-9a-f]{7,40}(?![\w-])")


def broken(page, text: str) -> list[str]:
    """Links of a page that lead to no file, or to no heading of it."""
    found = []
    for link in links(text):
        place = leads_to(page, link.target)
        if place is None:
            continue
        path, anchor = place
        if not path.exists() or ROOT not in (path, *path.parents):
            found.append(f"[{link.text}]({link.target}): there is no such file")
        elif anchor and path.suffix == ".md" and anchor not in anchors(path.read_text()):
            found.append(f"[{link.text}]({link.target}): there is no such heading")
    return found


def test_broken_links_are_found():
    text = (
        "[a](CHANGELOG.md) [b](NONE.md) [c](CHANGELOG.md#0-2-0) [d](CHANGELOG.md#020) `[e](x.md)`"
    )
    assert [line[:3] for line in broken(README, text)] == ["[b]", "[c]"]
    assert broken(README, "[out](../elsewhere.md) [web](https://example.org/none.md)")[
        0
    ].startswith("[out]")


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_no_link_is_broken(page):
    assert broken(page, page.read_text()) == []


def test_the_history_lists_all_its_pages():
    """In its table, which a reader sees, and in the tree of the site, which a glob fills."""
    listed = {target for _, target in links((HISTORY / "index.md").read_text())}
    there = {page.name for page in pages() if page.parent == HISTORY}
    assert there - {"index.md"} == {target for target in listed if "/" not in target}
    tree = (ROOT / "docs" / "index.md").read_text().split("```{toctree}")[-1]
    assert {"history/index", "history/*"} <= set(tree.split()) and ":glob:" in tree


def test_commits_are_found():
    text = (
        "at commit b43be93, or 8082e42; 1234567 episodes, defaced, arXiv 2404.04857, step-000240000"
    )
    assert COMMIT.findall(text) == ["b43be93", "8082e42"]


def test_no_page_of_the_present_names_a_commit():
    """Commits stand in ``docs/history`` and in the cards of policies."""
    cards = {ROOT / "docs" / "policy_card.md", ROOT / "uv.lock"}
    kinds = {".md", ".py", ".yaml", ".toml", ".txt", ".cff", ".sh", ".csv", ""}
    found = {}
    for path in tracked():
        if path in cards or path.suffix not in kinds or HISTORY in path.parents:
            continue
        if (ROOT / "recipes" / "policies") in path.parents or path.samefile(__file__):
            continue
        if commits := COMMIT.findall(path.read_text(errors="ignore")):
            found[name(path)] = commits
    assert found == {}


def test_what_is_left_is_no_code():
    assert without_code("a `b` c\n```\n[x](y)\n```\n") == "a  c\n\n"
