"""The examples run as they stand."""

from __future__ import annotations

import re

from examples import doorway, my_robot


def _arrived(printed: str) -> list[int]:
    return [int(number) for number in re.findall(r"(\d+) of 6 at the goal", printed)]


def test_doorway(capsys):
    doorway.main(episodes=6)
    assert min(_arrived(capsys.readouterr().out)) >= 5


def test_my_robot(capsys):
    my_robot.main(episodes=6)
    printed = capsys.readouterr().out
    assert re.match(r"my_robot: \d+ of its 541 beams meet something", printed)
    # The policy was trained with a smaller and slower one.
    assert sum(_arrived(printed)) >= 14
