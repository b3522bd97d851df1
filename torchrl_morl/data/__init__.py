"""Data for learning rewards from demonstrations."""

from torchrl_morl.data.demonstrations import load_demonstrations, save_demonstrations
from torchrl_morl.data.snippets import RankedSnippets

__all__ = ["RankedSnippets", "load_demonstrations", "save_demonstrations"]
