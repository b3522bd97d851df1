"""Diagnostics of a reward model that decide before any RL."""

from __future__ import annotations


def write_report(run_dir, cfg, model, policy, groups):
    return {}
