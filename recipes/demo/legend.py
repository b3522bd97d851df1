"""What a stranger sees in a film from above, in words: a line below the picture."""

from __future__ import annotations

import math

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

_INK, _PAPER = (30, 30, 30), (255, 255, 255)
_ROBOT, _GOAL = (52, 56, 66), (26, 26, 26)  # as they are drawn by MuJoCo
_FINE = 4  # pixels of a drawing for one of the picture: MuJoCo's edges are smooth, too


def star(x: float, y: float, radius: float) -> Tensor:
    """Corners of a pentagram in the order of one stroke, ``[6, 2]``; a tip points up.

    Examples:
        >>> corners = star(1.0, 2.0, radius=0.5)
        >>> corners[0].tolist(), bool((corners[0] == corners[-1]).all())
        ([1.0, 2.5], True)
    """
    angle = math.pi / 2 + torch.arange(5) * 2 * (2 * math.pi / 5)
    tips = torch.stack((x + radius * angle.cos(), y + radius * angle.sin()), dim=-1)
    return torch.cat((tips, tips[:1]))


def legend_strip(width: int, *, demonstration: bool) -> Tensor:
    """Robot, human, goal and the demonstrated path with their names.

    Args:
        width: pixels.

    Keyword Args:
        demonstration: whether there is such a path.

    Returns:
        ``uint8 [height, width, 3]``. A narrow one takes several lines.

    Examples:
        >>> legend_strip(640, demonstration=True).shape[1:]
        torch.Size([640, 3])
    """
    size = max(9, round(width / 46))
    font, gap = ImageFont.load_default(size), round(0.5 * size)
    names = ["robot", "human", "goal"] + ["demonstrated path"] * demonstration
    icons = [_robot, _human, _goal, _path][: len(names)]
    row, icon = round(1.7 * size), round(1.5 * size)
    places, left, line = [], gap, 0
    for name in names:
        needed = icon + gap + round(font.getlength(name))
        if left > gap and left + needed > width:
            left, line = gap, line + 1
        places.append((left, line))
        left += needed + 2 * size
    height = (line + 1) * row + gap // 2
    fine = Image.new("RGB", (width * _FINE, height * _FINE), _PAPER)
    draw = ImageDraw.Draw(fine)
    for paint, (left, line) in zip(icons, places, strict=True):
        middle = (left + icon / 2) * _FINE, (line * row + row / 2) * _FINE
        paint(draw, *middle, 0.5 * icon * _FINE)
    image = fine.resize((width, height), Image.Resampling.LANCZOS)
    draw = ImageDraw.Draw(image)
    for name, (left, line) in zip(names, places, strict=True):
        where = left + icon + gap, line * row + row / 2
        draw.text(where, name, font=font, fill=_INK, anchor="lm")
    return torch.from_numpy(np.array(image))


def _disc(draw: ImageDraw.ImageDraw, x: float, y: float, r: float, color: tuple[int, ...]) -> None:
    draw.ellipse((x - r, y - r, x + r, y + r), fill=color)


def _robot(draw: ImageDraw.ImageDraw, x: float, y: float, r: float) -> None:
    _disc(draw, x, y, 0.8 * r, _ROBOT)
    draw.line((x - 0.1 * r, y, x + 0.7 * r, y), fill=_PAPER, width=round(0.26 * r))


def _human(draw: ImageDraw.ImageDraw, x: float, y: float, r: float) -> None:
    _disc(draw, x, y, 0.75 * r, _GOAL)
    _disc(draw, x, y, 0.55 * r, _PAPER)
    draw.line((x - 1.1 * r, y, x, y), fill=_GOAL, width=round(0.25 * r))


def _goal(draw: ImageDraw.ImageDraw, x: float, y: float, r: float) -> None:
    # Rows of pixels grow downwards.
    tips = [(x + dx, y - dy) for dx, dy in star(0.0, 0.0, 0.85 * r).tolist()]
    draw.line(tips, fill=_GOAL, width=round(0.3 * r), joint="curve")


def _path(draw: ImageDraw.ImageDraw, x: float, y: float, r: float) -> None:
    for left in (-1.0, 0.2):
        draw.line((x + left * r, y, x + (left + 0.8) * r, y), fill=_GOAL, width=round(0.25 * r))
