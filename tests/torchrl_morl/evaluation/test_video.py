"""Films as files."""

from __future__ import annotations

import pytest
import torch
from PIL import Image

from torchrl_morl.evaluation import write_video


def film(count: int) -> torch.Tensor:
    """A bright square that moves over a grey floor."""
    frames = torch.full((count, 60, 80, 3), 200, dtype=torch.uint8)
    for step, frame in enumerate(frames):
        frame[10:20, 5 * step : 5 * step + 10] = torch.tensor([214, 51, 108], dtype=torch.uint8)
    return frames


def test_gif_keeps_its_colors_and_its_pace(tmp_path):
    frames = film(6)
    picture = Image.open(write_video(tmp_path / "folder" / "film.gif", frames, fps=10))
    assert picture.n_frames == 6
    for step, frame in enumerate(frames):
        picture.seek(step)
        assert picture.info["duration"] == 100
        shown = torch.frombuffer(bytearray(picture.convert("RGB").tobytes()), dtype=torch.uint8)
        assert (shown.view(60, 80, 3).int() - frame.int()).abs().max() <= 2


def test_a_picture_that_stays_is_written_once(tmp_path):
    frames = torch.cat((film(3), film(3)[-1:].expand(9, -1, -1, -1)))
    picture = Image.open(write_video(tmp_path / "film.gif", frames, fps=10))
    assert picture.n_frames == 3
    picture.seek(2)
    assert picture.info["duration"] == 1000


def test_no_frames_are_no_film(tmp_path):
    with pytest.raises(ValueError, match="at least one"):
        write_video(tmp_path / "film.gif", film(0))
    assert not list(tmp_path.iterdir())
