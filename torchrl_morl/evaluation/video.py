"""Writing videos without torchcodec, which TorchRL's own MP4 writer needs."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor
from torchrl.record import CSVLogger

from torchrl_morl._extras import from_extra

from .arrays import as_tensor

__all__ = ["VideoLogger", "write_video"]

VideoFormat = Literal["mp4", "gif"]

_PALETTE_FRAMES = 16
"""Frames that the colours of a GIF are chosen from."""


def write_video(path: str | Path, frames: Tensor, *, fps: float = 10.0) -> Path:
    """Write frames to an MP4 (H.264) or GIF file, by the suffix of its name.

    Args:
        path: the file; folders that do not exist are made.
        frames: ``uint8 [T, H, W, 3]``. H.264 needs even sizes, so an odd last row or column is
            left out.
        fps: frames per second.

    Returns:
        The path.

    Raises:
        ValueError: for other suffixes, dtypes or shapes.
        ImportError: without Pillow for a GIF, or imageio with imageio-ffmpeg for an MP4 file
            (``pip install 'torchrl-morl[viz]'``).
    """
    path = Path(path)
    if path.suffix not in (".mp4", ".gif"):
        raise ValueError(f"The suffix must be .mp4 or .gif, got {path.name!r}.")
    frames = as_tensor(frames)
    if frames.dtype != torch.uint8 or frames.ndim != 4 or frames.shape[-1] != 3 or not len(frames):
        raise ValueError(
            f"frames must be uint8 [T, H, W, 3], at least one, got {frames.dtype} "
            f"{list(frames.shape)}."
        )
    with from_extra("viz", "write_video"):
        if path.suffix == ".gif":
            import PIL.Image  # noqa: F401 - before any folder is made
        else:
            import imageio.v2 as imageio
            import imageio_ffmpeg  # noqa: F401 - imageio finds its encoder there
    path.parent.mkdir(parents=True, exist_ok=True)
    frames = frames.cpu()
    if path.suffix == ".gif":
        _write_gif(path, frames, fps)
        return path
    height, width = (size - size % 2 for size in frames.shape[1:3])
    with imageio.get_writer(path, fps=fps, macro_block_size=2, quality=8) as writer:
        for frame in frames[:, :height, :width].numpy():
            writer.append_data(frame)
    return path


def _write_gif(path: Path, frames: Tensor, fps: float) -> None:
    """One palette for the whole film: it does not flicker, and the file is half as large."""
    from PIL import Image

    count, width = len(frames), frames.shape[2]
    shown = frames[torch.linspace(0, count - 1, min(count, _PALETTE_FRAMES)).round().long()]
    sheet = Image.fromarray(shown.reshape(-1, width, 3).numpy())
    palette = sheet.quantize(256, method=Image.Quantize.MEDIANCUT)
    pictures = [
        Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE)
        for frame in frames.numpy()
    ]
    # Pillow shows a picture for longer instead of writing it again.
    pictures[0].save(
        path, save_all=True, append_images=pictures[1:], duration=1000 / fps, loop=0, optimize=True
    )


class VideoLogger(CSVLogger):
    """A :class:`~torchrl.record.CSVLogger` that writes its videos with imageio.

    Give it to :class:`~torchrl.record.VideoRecorder`. Files are
    ``log_dir/exp_name/videos/{tag}_{step}.mp4``.

    Args:
        exp_name: name of the experiment.
        log_dir: where it is saved.
        video_format: ``"mp4"`` or ``"gif"``.
        video_fps: frames per second.
    """

    def __init__(
        self,
        exp_name: str,
        log_dir: str | Path | None = None,
        video_format: VideoFormat = "mp4",
        video_fps: int = 10,
    ) -> None:
        log_dir = None if log_dir is None else str(log_dir)
        super().__init__(exp_name, log_dir, video_format=video_format, video_fps=video_fps)

    def log_video(self, name: str, video: Tensor, step: int | None = None, **kwargs: Any) -> None:
        """Write a video ``uint8 [1, T, 3, H, W]``; of the ``kwargs`` only ``fps`` is known."""
        if step is None:
            step = self.experiment.videos_counter[name]
            self.experiment.videos_counter[name] += 1
        path = Path(self.experiment.log_dir, "videos", f"{name}_{step}.{self.video_format}")
        frames = video.flatten(0, -4).movedim(-3, -1)
        write_video(path, frames, fps=kwargs.get("fps", self.video_fps))
