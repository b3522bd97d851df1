"""The site: ``make docs`` writes it to ``docs/_build/html``; a warning is an error."""

from __future__ import annotations

import os
import sys

sys.path.insert(0, os.path.abspath(".."))

import torchrl_morl

project = "torchrl-morl"
author = "The torchrl-morl contributors"
version = release = torchrl_morl.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
html_theme = "furo"
exclude_patterns = ["_build"]
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4
autodoc_typehints = "description"
