"""Recipes: each a readable script that composes the library and the simulation."""
