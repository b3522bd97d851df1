"""What tests do with an opened page."""

from __future__ import annotations

import numpy as np

SHOWCASE = "#scene=showcase&policy=navigation&person=stands"


def drive(page, steps: int = 300) -> np.ndarray:
    """The robot's places ``[T, 2]`` in the next control steps, as far as the episode goes."""
    code = "n => { const s = page.session; for (let i = 0; i < n && !s.episode.ending; i++) s.step(); return s.points; }"
    return np.array(page.evaluate(code, steps))


def drag(page, start, end) -> None:
    page.mouse.move(*start)
    page.mouse.down()
    page.mouse.move(*((a + b) / 2 for a, b in zip(start, end)))
    page.mouse.move(*end)
    page.mouse.up()


def on_floor(page, x: float, y: float) -> list[float]:
    """Where a place of the floor is in the window, pixels."""
    code = """([x, y]) => {
        const [px, py] = page.floor.at([x, y]);
        const frame = page.floor.canvas.getBoundingClientRect();
        return [px + frame.left, py + frame.top];
    }"""
    return page.evaluate(code, [x, y])


def corners(page) -> list[tuple[float, float]]:
    """Of the triangle in the window, pixels: demonstration, distance, efficiency."""
    frame = page.locator("#triangle canvas").bounding_box()
    bottom = frame["y"] + frame["height"] - 1
    right = frame["x"] + frame["width"] - 1
    return [
        (frame["x"] + frame["width"] / 2, frame["y"] + 1),
        (frame["x"] + 1, bottom),
        (right, bottom),
    ]
