"""The preference, drawn into pictures as a small bar chart."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchrl_morl._extras import from_extra

from .arrays import as_tensor

__all__ = ["BAR_COLORS", "draw_preference"]

BAR_COLORS: tuple[tuple[int, int, int], ...] = (
    (204, 121, 167),
    (0, 114, 178),
    (230, 159, 0),
    (0, 158, 115),
    (86, 180, 233),
    (213, 94, 0),
)
"""Colours of the bars, from Okabe and Ito's colour-blind safe palette; they repeat after six."""

_TRACK = (222, 222, 222)
_INK = (30, 30, 30)
_OPACITY = 0.8


class _Panel(NamedTuple):
    """The part of the chart that does not depend on the preference."""

    color: np.ndarray  # [h, w, 3], already multiplied by the opacity
    transparency: np.ndarray  # [h, w, 1], how much of the frame shows through
    top: int
    left: int
    bar_left: int
    bar_width: int
    bar_tops: tuple[int, ...]
    bar_height: int


@functools.lru_cache(maxsize=16)
def _panel(names: tuple[str, ...], height: int, width: int) -> _Panel:
    with from_extra("viz", "draw_preference"):
        from PIL import Image, ImageDraw, ImageFont
    size = max(9, round(height / 26))
    font = ImageFont.load_default(size)
    text_width = max(round(font.getlength(name)) for name in names)
    pad, row, bar_width = round(0.6 * size), round(1.45 * size), 6 * size
    shape = (3 * pad + text_width + bar_width, 2 * pad + row * len(names) - round(0.3 * size))
    margin = round(0.5 * size)
    if shape[0] + 2 * margin > width or shape[1] + 2 * margin > height:
        raise ValueError(
            f"Frames of {width} x {height} pixels are too small for a chart of {shape[0]} x "
            f"{shape[1]} (and a margin of {margin}): render larger frames, or use shorter names."
        )
    image = Image.new("RGBA", shape, (255, 255, 255, 0))
    draw = ImageDraw.Draw(image)
    box = (0, 0, shape[0] - 1, shape[1] - 1)
    draw.rounded_rectangle(box, radius=pad, fill=(255, 255, 255, round(255 * _OPACITY)))
    tops = tuple(pad + row * i for i in range(len(names)))
    bar_left, bar_height = 2 * pad + text_width, size
    for name, top in zip(names, tops, strict=True):
        draw.text((pad, top + size / 2), name, font=font, fill=(*_INK, 255), anchor="lm")
        draw.rectangle(
            (bar_left, top, bar_left + bar_width - 1, top + bar_height - 1), fill=(*_TRACK, 255)
        )
    pixels = np.asarray(image, dtype=np.float32)
    opacity = pixels[..., 3:] / 255
    return _Panel(
        color=pixels[..., :3] * opacity,
        transparency=1 - opacity,
        top=margin,
        left=margin,
        bar_left=bar_left,
        bar_width=bar_width,
        bar_tops=tops,
        bar_height=bar_height,
    )


def draw_preference(frames: Tensor, preference: Tensor, names: Sequence[str]) -> Tensor:
    """Draw a bar chart of the preference into the upper left corner of every frame.

    A full bar is a weight of one. The chart scales with the height of the frames.

    Args:
        frames: ``uint8 [*B, H, W, 3]``.
        preference: ``[*B, T]``, or ``[T]`` for all frames.
        names: of the ``T`` tunable objectives.

    Returns:
        New frames, of the shape and on the device of the given ones.

    Raises:
        ValueError: if dtype or shapes do not fit, or if the frames are too small for the chart.
        ImportError: without Pillow (``pip install 'torchrl-morl[viz]'``).

    Example:
        >>> import torch
        >>> frames = torch.zeros(2, 120, 200, 3, dtype=torch.uint8)
        >>> preference = torch.tensor([[0.2, 0.8], [1.0, 0.0]])
        >>> draw_preference(frames, preference, ("distance", "efficiency")).shape
        torch.Size([2, 120, 200, 3])

    """
    names, frames, preference = tuple(names), as_tensor(frames), as_tensor(preference)
    if frames.dtype != torch.uint8 or frames.ndim < 3 or frames.shape[-1] != 3:
        raise ValueError(
            f"frames must be uint8 [*B, H, W, 3], got {frames.dtype} {list(frames.shape)}."
        )
    preference = preference.detach().cpu().double()
    if not names or preference.ndim == 0 or preference.shape[-1] != len(names):
        raise ValueError(
            f"preference must have one entry for each of the names {names}, got shape "
            f"{list(preference.shape)}."
        )
    batch, (height, width) = frames.shape[:-3], frames.shape[-3:-1]
    if preference.ndim > 1 and preference.shape[:-1] != batch:
        raise ValueError(
            f"preference of batch shape {list(preference.shape[:-1])} does not fit frames of "
            f"{list(batch)}."
        )
    panel = _panel(names, height, width)
    out = frames.detach().to("cpu", copy=True).contiguous()
    pixels = out.view(-1, height, width, 3).numpy()
    shares = preference.expand(*batch, len(names)).reshape(-1, len(names)).clamp(0, 1)
    lengths = (shares * panel.bar_width).round().long().tolist()
    rows, columns = panel.color.shape[:2]
    corner = pixels[:, panel.top : panel.top + rows, panel.left : panel.left + columns]
    corner[...] = np.rint(corner * panel.transparency + panel.color).astype(np.uint8)
    for chart, bars in zip(corner, lengths, strict=True):
        for index, (top, length) in enumerate(zip(panel.bar_tops, bars, strict=True)):
            bar = chart[top : top + panel.bar_height, panel.bar_left : panel.bar_left + length]
            bar[...] = BAR_COLORS[index % len(BAR_COLORS)]
    return out.to(frames.device)
