"""Bars of preferences: their colours, and the strip above a picture."""

from __future__ import annotations

import pytest
import torch

from torchrl_morl import PreferenceSpace
from torchrl_morl.evaluation import draw_preference, preference_strip
from torchrl_morl.evaluation.overlay import BAR_COLORS
from torchrl_morl.transforms import PreferenceOverlay

NAMES = ("demonstration", "distance", "efficiency")
COLORS = [[0.2, 0.4, 0.6], [1.0, 0.0, 0.0], [0.0, 1.0, 0.2]]
BYTES = torch.tensor([[51, 102, 153], [255, 0, 0], [0, 255, 51]], dtype=torch.uint8)


def pixels(picture: torch.Tensor, color) -> int:
    """How many have exactly this colour."""
    return int((picture == torch.as_tensor(color)).all(-1).sum())


def test_bars_have_the_given_colors():
    frames = torch.full((2, 180, 320, 3), 90, dtype=torch.uint8)
    weights = torch.tensor([0.5, 0.3, 0.2])
    out = draw_preference(frames, weights, NAMES, colors=COLORS)
    plain = draw_preference(frames, weights, NAMES)
    for color, default in zip(BYTES, BAR_COLORS, strict=False):
        assert pixels(out, color) == pixels(plain, default) > 0
        assert pixels(out, default) == pixels(plain, color) == 0


@pytest.mark.parametrize(
    "colors",
    [COLORS[:2], [[0.0, 0.0]] * 3, [[0, 0, 255]] * 3, [[0.0, 0.0, -0.1]] * 3],
    ids=["two", "pairs", "bytes", "negative"],
)
def test_colors_that_are_none(colors):
    frames = torch.zeros(180, 320, 3, dtype=torch.uint8)
    preference_space = PreferenceSpace(("core", *NAMES), static={"core": 1.0})
    with pytest.raises(ValueError, match=r"colors must be \[3, 3\]"):
        draw_preference(frames, torch.ones(3) / 3, NAMES, colors=colors)
    with pytest.raises(ValueError, match=r"colors must be \[3, 3\]"):
        preference_strip(torch.ones(3) / 3, NAMES, width=640, colors=colors)
    with pytest.raises(ValueError, match=r"colors must be \[3, 3\]"):
        PreferenceOverlay(preference_space, colors=colors)


def test_overlay_passes_its_colors_on():
    preference_space = PreferenceSpace(("core", *NAMES), static={"core": 1.0})
    data = {"pixels": torch.zeros(180, 320, 3, dtype=torch.uint8), "preference": torch.ones(3) / 3}
    from tensordict import TensorDict

    drawn = PreferenceOverlay(preference_space, colors=COLORS)(TensorDict(data))["pixels"]
    assert all(pixels(drawn, color) > 0 for color in BYTES)


@pytest.mark.parametrize("width", [640, 800, 300, 160])
def test_strip_shows_square_and_bar(width):
    """Every colour is there without weight, and a bar grows by its weight alone."""
    none = preference_strip([0.0, 0.0, 0.0], NAMES, width=width, colors=COLORS)
    full = preference_strip([1.0, 1.0, 1.0], NAMES, width=width, colors=COLORS)
    some = preference_strip([0.5, 0.25, 0.0], NAMES, width=width, colors=COLORS)
    assert none.dtype == torch.uint8
    assert none.shape == full.shape == some.shape
    assert none.shape[1] == width
    square = [pixels(none, color) for color in BYTES]
    assert square[0] == square[1] == square[2] > 0
    bar = [pixels(full, color) - square[0] for color in BYTES]
    assert bar[0] == bar[1] == bar[2] >= 2 * square[0]
    side = round(square[0] ** 0.5)
    lengths = [(pixels(some, color) - square[0]) / side for color in BYTES]
    assert lengths == pytest.approx([0.5 * bar[0] / side, 0.25 * bar[0] / side, 0.0], abs=0.51)


def test_strip_takes_a_line_more_where_it_is_narrow():
    heights = [
        preference_strip([0.2, 0.3, 0.5], NAMES, width=width).shape[0] for width in (300, 220)
    ]
    assert heights[0] < heights[1]


@pytest.mark.parametrize("width", [640, 800, 300, 160])
def test_nothing_of_a_strip_is_cut(width):
    """The outermost rows and columns are paper."""
    strip = preference_strip([0.25, 0.5, 0.25], NAMES, width=width)
    border = torch.cat((strip[0], strip[-1], strip[:, 0], strip[:, -1]))
    assert border.min() == 255


def test_strip_refuses_what_does_not_fit():
    with pytest.raises(ValueError, match="too small for a chart"):
        preference_strip([0.5, 0.5], ("distance", "efficiency"), width=60)
    with pytest.raises(ValueError, match="one entry for each"):
        preference_strip([0.5, 0.5], NAMES, width=640)
    with pytest.raises(ValueError, match=r"must be \[3\]"):
        preference_strip(torch.ones(2, 3) / 3, NAMES, width=640)
