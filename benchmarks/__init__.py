"""Benchmarks: scripts that measure, see README.md."""

from pathlib import Path

POLICY = Path(__file__).parents[1] / "recipes" / "policies" / "polished_seed0"
"""It reads what most robots have: a scan, a goal and where the human is."""
