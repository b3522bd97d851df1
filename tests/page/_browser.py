"""What tests do with an opened page."""

from __future__ import annotations

import numpy as np

SHOWCASE = "#scene=showcase&policy=navigation&person=stands"


def drive(page, steps: int = 300) -> np.ndarray:
    """The robot's places ``[T, 2]`` in the next control steps, as far as the episode goes."""
    code = "n => { const s = page.session; for (let i = 0; i < n && !s.episode.ending; i++) s.step(); return s.points; }"
    return np.array(page.evaluate(code, steps))
