"""Growth benchmark: every case runs at small sizes, and the table says how it grows."""

from __future__ import annotations

import math

import pytest

from benchmarks import growth
from benchmarks.growth_cases import CASES, Cost, Options, peak

pytestmark = pytest.mark.benchmark

OPTIONS = Options(clock="cpu", seconds=0.0, scenes=2, steps=3)


@pytest.mark.parametrize("case", CASES)
def test_cases_run(case):
    assert CASES[case](3, OPTIONS) > 0


def test_peak_is_in_bytes():
    before = peak()
    held = bytearray(100_000_000)
    assert peak() >= before
    assert 1e8 < peak() < 1e12
    del held


@pytest.mark.parametrize(
    ("power", "word"),
    [(0.0, "flat"), (0.5, "below linear"), (1.0, "linear"), (2.0, "worse than linear")],
)
def test_verdict_follows_the_largest_sizes(power, word):
    # A fixed cost at the small sizes must not hide it.
    costs = {size: max(float(size) ** power, 50.0**power) for size in (1, 10, 100, 1000)}
    assert growth.exponent(costs) == pytest.approx(power)
    assert growth.verdict(growth.exponent(costs)) == word


def test_one_size_has_no_verdict():
    assert growth.verdict(growth.exponent({3: 1.0})) == "one size"
    assert math.isnan(growth.exponent({3: 1.0}))


def test_memory_is_full_along_the_line():
    costs = {1: Cost(1, 5e6), 10: Cost(1, 14e6), 100: Cost(1, 104e6)}
    assert growth.full_at(costs, 4e6 + 50_000 * 1e6) == "50,000"


def test_table_has_two_rows_for_everything_that_grows():
    costs = {
        "environments": {1: Cost(0.001, 40e6), 1000: Cost(0.01, 40e6)},
        "replay": {10: Cost(0.001, 10e6), 1000: Cost(0.001, 1000e6)},
    }
    header, _, *rows = growth.table(costs, 24e9).splitlines()
    assert [row.split(" | ")[-2] for row in rows] == ["below linear", "flat", "flat", "linear"]
    assert "| 1 / 1,000 | steps/s | 1,000 / 100,000 | 0.33 |" in rows[0]
    assert rows[3].endswith(
        "| 10 / 1,000 | peak memory, MB | 10 / 1,000 | 1.00 | linear | 24,000 |"
    )
    assert header.count("|") == rows[0].count("|")


def test_script_measures_in_processes_of_their_own(tmp_path, capsys):
    output = tmp_path / "growth.csv"
    command = ["--grows", "objectives", "--sizes", "2", "3", "--seconds", "0", "--clock", "cpu"]
    growth.main([*command, "--output", str(output)])
    assert "| objectives | 2 / 3 | losses and relabelling, ms |" in capsys.readouterr().out
    assert [line.split(",")[:2] for line in output.read_text().splitlines()] == [
        ["grows", "size"],
        ["objectives", "2"],
        ["objectives", "3"],
    ]


def test_script_refuses_sizes_of_several_things(capsys):
    with pytest.raises(SystemExit):
        growth.main(["--sizes", "1", "2"])
    assert "those of one --grows" in capsys.readouterr().err
