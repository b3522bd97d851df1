"""The preference as a small bar chart: drawn into pictures, or on a strip of its own above them."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from torchrl_morl._extras import from_extra

from .arrays import as_tensor

__all__ = ["BAR_COLORS", "draw_preference", "preference_strip"]

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


def _pillow() -> tuple[Any, Any, Any]:
    with from_extra("viz", "draw_preference"):
        from PIL import Image, ImageDraw, ImageFont
    return Image, ImageDraw, ImageFont


@functools.lru_cache(maxsize=16)
def _panel(names: tuple[str, ...], height: int, width: int) -> _Panel:
    Image, ImageDraw, ImageFont = _pillow()
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


def draw_preference(
    frames: Tensor,
    preference: Tensor,
    names: Sequence[str],
    *,
    colors: ArrayLike | None = None,
) -> Tensor:
    """Draw a bar chart of the preference into the upper left corner of every frame.

    A full bar is a weight of one. The chart scales with the height of the frames.

    Args:
        frames: ``uint8 [*B, H, W, 3]``.
        preference: ``[*B, T]``, or ``[T]`` for all frames.
        names: of the ``T`` tunable objectives.

    Keyword Args:
        colors: of the bars, ``[T, 3]``, red, green and blue from 0 to 1; defaults to
            :data:`BAR_COLORS`.

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
    preference = _weights(preference, names)
    colors = bar_colors(colors, names)
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
        for color, top, length in zip(colors, panel.bar_tops, bars, strict=True):
            bar = chart[top : top + panel.bar_height, panel.bar_left : panel.bar_left + length]
            bar[...] = color
    return out.to(frames.device)


def preference_strip(
    preference: Tensor | Sequence[float],
    names: Sequence[str],
    *,
    width: int,
    colors: ArrayLike | None = None,
) -> Tensor:
    """A bar chart of one preference as a picture of its own, to put above others of that width.

    In front of every name is a square in its colour, also where the weight is zero; behind every
    bar is the weight.

    Args:
        preference: ``[T]``.
        names: of the ``T`` tunable objectives.

    Keyword Args:
        width: pixels.
        colors: of the bars, as in :func:`draw_preference`.

    Returns:
        ``uint8 [height, width, 3]``. All preferences over the same names have the same height.

    Raises:
        ValueError: if shapes do not fit, or if the width is too small for the names.

    Example:
        >>> strip = preference_strip([0.2, 0.8], ("distance", "efficiency"), width=320)
        >>> frame = torch.zeros(180, 320, 3, dtype=torch.uint8)
        >>> torch.cat((strip, frame)).shape[1:]
        torch.Size([320, 3])

    """
    Image, ImageDraw, ImageFont = _pillow()
    names = tuple(names)
    weights = _weights(preference, names)
    if weights.ndim != 1:
        raise ValueError(f"preference must be [{len(names)}], got {list(weights.shape)}.")
    colors = bar_colors(colors, names)
    size = max(9, round(width / 46))
    font, gap = ImageFont.load_default(size), round(0.4 * size)
    margin, shortest = 2 * gap, 3 * size
    # What an entry needs beside its bar: the square, the name, the weight, and what is between.
    number = round(font.getlength("0.00"))
    needs = [size + round(font.getlength(name)) + number + 3 * gap for name in names]

    def bar_length(columns: int) -> int:
        """In so many columns, as long as the widest line allows."""
        lines = [needs[first : first + columns] for first in range(0, len(names), columns)]
        free = (width - margin - sum(line) - 2 * size * (len(line) - 1) for line in lines)
        return min(left // len(line) for left, line in zip(free, lines, strict=True))

    columns = next((n for n in range(len(names), 0, -1) if bar_length(n) >= shortest), 0)
    if not columns:
        raise ValueError(
            f"A strip of {width} pixels is too small for a chart of {names}: give it at least "
            f"{max(needs) + shortest + margin}, or use shorter names."
        )
    length, row = bar_length(columns), round(1.6 * size)
    lines = -(-len(names) // columns)
    image = Image.new("RGB", (width, lines * row + gap), (255, 255, 255))
    draw = ImageDraw.Draw(image)
    left = top = gap
    for index, (name, weight) in enumerate(zip(names, weights.tolist(), strict=True)):
        if index and index % columns == 0:
            left, top = gap, top + row
        bottom, middle, color = top + size - 1, top + size / 2, colors[index]
        draw.rectangle((left, top, left + size - 1, bottom), fill=color)
        draw.text((left + size + gap, middle), name, font=font, fill=_INK, anchor="lm")
        bar = left + needs[index] - number - gap
        draw.rectangle((bar, top, bar + length - 1, bottom), fill=_TRACK)
        if filled := round(min(max(weight, 0.0), 1.0) * length):
            draw.rectangle((bar, top, bar + filled - 1, bottom), fill=color)
        text = f"{weight:.2f}".removesuffix("0")
        draw.text((bar + length + gap, middle), text, font=font, fill=_INK, anchor="lm")
        left += needs[index] + length + 2 * size
    return torch.from_numpy(np.array(image))


def _weights(preference: Tensor | Sequence[float], names: tuple[str, ...]) -> Tensor:
    preference = as_tensor(preference).detach().cpu().double()
    if not names or preference.ndim == 0 or preference.shape[-1] != len(names):
        raise ValueError(
            f"preference must have one entry for each of the names {names}, got shape "
            f"{list(preference.shape)}."
        )
    return preference


def bar_colors(colors: ArrayLike | None, names: tuple[str, ...]) -> list[tuple[int, ...]]:
    """Colours of the bars from 0 to 255, one for each name.

    Args:
        colors: see :func:`draw_preference`.
        names: of the ``T`` tunable objectives.

    Raises:
        ValueError: for another shape than ``[T, 3]``, or values outside of 0 to 1.
    """
    if colors is None:
        return [BAR_COLORS[index % len(BAR_COLORS)] for index in range(len(names))]
    values = np.asarray(colors, dtype=float)
    if values.shape != (len(names), 3) or not ((values >= 0) & (values <= 1)).all():
        raise ValueError(
            f"colors must be [{len(names)}, 3] (red, green and blue of {names}) from 0 to 1, got "
            f"{values.tolist()}."
        )
    return [tuple(row) for row in np.rint(255 * values).astype(int).tolist()]
