"""README can be read to its end, and whatever a newcomer asks is two clicks away."""

from __future__ import annotations

import re

import pytest
import yaml

import torchrl_morl

from ._pages import (
    README,
    ROOT,
    anchors,
    blocks,
    leads_to,
    links,
    pages,
    tables,
    without_code,
    words,
)

TEXT = README.read_text()
MOST_WORDS, MOST_TABLES = 600, 2


def test_words_are_counted_without_code_tables_and_targets():
    text = "# A title\n\nTwo [linked words](https://a.b/c-d) - and `code`, 3.5 m.\n\n![no](x.png)\n"
    assert words(text + "```bash\nnot this\n```\n| nor | this |\n|---|---|\n") == 9
    assert tables(text + "| a |\n|---|\n| b |\n\n| a | b |\n|---|:-:|\n") == 2


def test_it_is_short():
    assert words(TEXT) <= MOST_WORDS
    assert tables(TEXT) <= MOST_TABLES


def test_the_film_comes_first_and_a_style_of_ones_own_next():
    pictures = re.findall(r"!\[[^\]]*\]\(([^)]*)\)", without_code(TEXT))
    assert pictures[:2] == ["docs/images/sweep.gif", "docs/images/style.png"]


def test_every_job_has_its_snippet():
    parts = re.split(r"^### ", TEXT.split("## What you can do")[1].split("\n## ")[0], flags=re.M)[
        1:
    ]
    assert len(parts) >= 3
    for part in parts:
        assert blocks(part), part.splitlines()[0]


def within(clicks: int) -> dict:
    """Pages that can be reached, and the anchors that links name on them."""
    reached = {README: {""}}
    frontier = [README]
    for _ in range(clicks):
        found = []
        for page in frontier:
            for link in links(page.read_text()):
                place = leads_to(page, link.target)
                if place and place[0].suffix == ".md" and place[0].exists():
                    if place[0] not in reached:
                        found.append(place[0])
                    reached.setdefault(place[0], set()).add(place[1])
        frontier = found
    return reached


QUESTIONS = {
    "train my style": ("docs/how_to/style.md", "recipes.teach"),
    "my robot": ("docs/how_to/robot.md", "--robot my_robot.yaml"),
    "my scene": ("docs/how_to/scene.md", "--scene doorway.yaml"),
    "my objective": ("docs/how_to/objective.md", "OBJECTIVES"),
    "MOTD3Loss on MO-Gymnasium": ("docs/mo_gymnasium.md", "MOTD3Loss("),
    "unit-test my loss": ("docs/reuse.md", "random_transitions"),
    "what train/q_scale means": ("docs/pd_morl.md", "q_scale"),
    "how it differs from the paper": ("docs/deviations.md", "600,000 steps"),
    "how 99.9 % was measured": ("docs/results/index.md", "recipes.results.evaluate"),
    "cite it": ("README.md", "@inproceedings"),
}


@pytest.mark.parametrize("question", QUESTIONS)
def test_it_is_two_clicks_away(question):
    place, says = QUESTIONS[question]
    page = ROOT / place
    assert page in within(2)
    assert says in page.read_text()


def test_the_parts_and_their_tests_are_linked_where_they_stand():
    """A link into a page names a heading, and the heading is there."""
    assert "how-do-i-unit-test-my-own-loss" in anchors((ROOT / "docs" / "reuse.md").read_text())
    assert "how-do-i-unit-test-my-own-loss" in within(1)[ROOT / "docs" / "reuse.md"]


def test_the_citation_is_that_of_the_file():
    (entry,) = blocks(TEXT, "bibtex")
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    paper = citation["preferred-citation"]
    assert citation["version"] == torchrl_morl.__version__
    assert paper["title"] in entry.code
    assert f"{{{paper['year']}}}" in entry.code
    names = [f"{one['family-names']}, {one['given-names']}" for one in paper["authors"]]
    assert " and ".join(names) in entry.code


def asks(page) -> bool:
    """Whether the title of a page is a question."""
    return page.read_text().lstrip().splitlines()[0].endswith("?")


def test_every_page_asks_one_question():
    """But for the first one, those that show a file from elsewhere, and the reference."""
    docs = ROOT / "docs"
    others = {
        docs / name for name in ("index.md", "changelog.md", "contributing.md", "benchmarks.md")
    }
    found = [
        page
        for page in pages(history=False)
        if docs in page.parents and page not in others and page.parent != docs / "api"
    ]
    assert len(found) > 20
    assert [page.name for page in found if not asks(page)] == []
