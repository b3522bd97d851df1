"""The benchmark of workers: its table by hand, and a tiny run."""

from __future__ import annotations

import pytest

from benchmarks import workers
from tests._workers import needs_ray


def test_a_batch_takes_the_learner_and_its_slowest_worker():
    wall = {0: [4.0, 8.0], 2: [2.0, 4.0]}
    cpu = {0: [[4.0], [4.0]], 2: [[1.0, 1.0, 0.5], [1.0, 1.0, 0.5]]}
    _, _, one, two = workers.table(wall, cpu, steps=1_000_000)
    assert one == "| one process | 166,667 | 1.00 | 4.0 | 0.0 | 1.00 |"
    assert two == "| 2 workers | 333,333 | 2.00 | 1.0 | 1.0 | 2.00 |"


@needs_ray
@pytest.mark.slow
def test_measures(tmp_path, capsys):
    output = tmp_path / "workers.md"
    options = ("--workers", "1", "--num-envs", "2", "--steps", "3", "--rounds", "1")
    workers.main([*options, "--output", str(output)])
    text = output.read_text()
    assert "| one process |" in text and "| 1 worker |" in text and "A transition has " in text
    assert text.strip() in capsys.readouterr().out
