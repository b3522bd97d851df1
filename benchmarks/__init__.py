"""Benchmarks: scripts that measure, see README.md."""
