"""Folders of evaluations that somebody has edited, cut off or mixed up: one line that names file and field."""

from __future__ import annotations

import csv
import json

import pytest

from recipes.results.files import EPISODES, SUMMARY, TRAJECTORIES, read_evaluation
from tests._results import fabricate


@pytest.fixture
def folder(tmp_path):
    return fabricate(tmp_path)


def refused(folder, *words):
    with pytest.raises(ValueError) as caught:
        read_evaluation(folder)
    message = str(caught.value)
    assert "\n" not in message and str(folder) in message, message
    assert all(word in message for word in words), message


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (b"", ("not valid JSON",)),
        (b"{}", ("lacks",)),
        (b"[]", ("must be an object", "[]")),
        (b"[" * 200_000, ("nested too deeply",)),
        (b'{"episodes": 4, "episodes": 5}', ("'episodes' stands there twice",)),
    ],
    ids=["empty", "no entries", "a list", "deep", "an entry twice"],
)
def test_a_summary_that_is_none(folder, text, words):
    (folder / SUMMARY).write_bytes(text)
    refused(folder, SUMMARY, *words)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("episodes", "4"),
        ("episodes", 0),
        ("num_preferences", 6.5),
        ("edge_steps", 1),
        ("scene_seed", None),
        ("members", 2),
        ("members", []),
        ("members", [{}, {}]),
        ("objectives", "demo"),
        ("ignores_preference", 1),
        ("condition", ["static"]),
        ("system", ""),
    ],
)
def test_an_entry_of_another_kind(folder, name, value):
    summary = json.loads((folder / SUMMARY).read_text())
    (folder / SUMMARY).write_text(json.dumps(summary | {name: value}))
    refused(folder, SUMMARY, "seed" if value == [{}, {}] else name)
    del summary[name]
    (folder / SUMMARY).write_text(json.dumps(summary))
    refused(folder, SUMMARY, f"lacks {name!r}")


def edited(folder, change):
    with (folder / EPISODES).open(newline="") as file:
        rows = list(csv.reader(file))
    change(rows)
    with (folder / EPISODES).open("w", newline="") as file:
        csv.writer(file).writerows(rows)


def put(column, text):
    """Replace a cell of the fifth line."""
    return lambda rows: rows[4].__setitem__(rows[0].index(column), text)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda rows: rows.clear(), ("is empty",)),
        (lambda rows: rows[4].pop(), ("line 5", "cells")),
        (lambda rows: rows[4].append("1"), ("line 5", "cells")),
        (put("time", "soon"), ("line 5", "time", "'soon'")),
        (put("frechet", "inf"), ("line 5", "frechet", "'inf'")),
        (
            lambda rows: rows[0].__setitem__(rows[0].index("timeout"), "success"),
            ("'success' twice",),
        ),
        (lambda rows: rows.insert(1, rows.pop()), ("line 2", "order")),
        (put("seed", "5"), ("line 5", "seed")),
    ],
    ids=["empty", "cut off", "too long", "text", "infinite", "column twice", "order", "seed"],
)
def test_episodes_that_are_none(folder, change, words):
    edited(folder, change)
    refused(folder, EPISODES, *words)


def test_episodes_that_are_no_text(folder):
    (folder / EPISODES).write_bytes(b"\x86\xff" * 500)
    refused(folder, EPISODES, "no text")


@pytest.mark.parametrize("data", [b"", b"PK\x03\x04 cut off", b"\x80\x04}."])
def test_trajectories_that_are_none(folder, data):
    (folder / TRAJECTORIES).write_bytes(data)
    with pytest.raises(ValueError, match=rf"^\S*{TRAJECTORIES} cannot be read: "):
        read_evaluation(folder).trajectories  # noqa: B018


def test_a_robot_that_is_never_on_course_for_a_collision(folder):
    edited(
        folder,
        lambda rows: (
            [row.append("inf") for row in rows[1:]] and rows[0].append("min_time_to_collision")
        ),
    )
    assert read_evaluation(folder).values("min_time_to_collision").max() == float("inf")
