"""What the paper reports (arXiv:2404.04857, Table I and section V-C), in its own simulation."""

from __future__ import annotations

import math

COLUMNS = (
    "success",
    "collision",
    "timeout",
    "min_human_distance",
    "frechet",
    "time",
)
"""Per cent for the first three, over all preferences; then metres at distance = 1, metres at
demo = 1 and seconds at efficiency = 1."""

CONDITION = "static"
"""That of the table: its moving human is shown, not counted."""

_NONE = math.nan

TABLE: dict[str, tuple[float, ...]] = {
    "OUR": (100.0, 0.0, 0.0, 1.18, 0.41, 17.3),
    "NH": (96.8, 2.7, 0.5, 0.52, 0.57, 16.9),
    "RM": (100.0, 0.0, 0.0, 1.16, 0.46, 17.4),
    "RM-NH": (79.6, 11.4, 9.0, 0.48, 0.49, 19.2),
    "SAC-PR": (45.4, 53.2, 1.2, 1.06, _NONE, _NONE),
    "SAC-PR-gamma": (54.5, 44.4, 1.1, 0.91, 1.06, 20.8),
    "CORE": (_NONE, _NONE, _NONE, 0.64, _NONE, _NONE),
}
"""By the name of the system in ``NAME=FOLDER``; the paper writes -NH for NH and so on. CORE has no
preference; the paper gives the mean of its smallest distance to the human."""
