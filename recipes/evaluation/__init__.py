"""Policies in fixed scenes: sweeps over preferences, and drivers without reinforcement learning beside them."""
