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
        ImportError: without imageio, or imageio-ffmpeg for an MP4 file
            (``pip install 'torchrl-morl[viz]'``).
    """
    path = Path(path)
    if path.suffix not in (".mp4", ".gif"):
        raise ValueError(f"The suffix must be .mp4 or .gif, got {path.name!r}.")
    frames = as_tensor(frames)
    if frames.dtype != torch.uint8 or frames.ndim != 4 or frames.shape[-1] != 3:
        raise ValueError(
            f"frames must be uint8 [T, H, W, 3], got {frames.dtype} {list(frames.shape)}."
        )
    with from_extra("viz", "write_video"):
        import imageio.v2 as imageio

        if path.suffix == ".mp4":
            import imageio_ffmpeg  # noqa: F401 - imageio finds its encoder there

    path.parent.mkdir(parents=True, exist_ok=True)
    frames = frames.cpu()
    if path.suffix == ".gif":
        imageio.mimwrite(path, list(frames.numpy()), duration=1000 / fps, loop=0)
        return path
    height, width = (size - size % 2 for size in frames.shape[1:3])
    with imageio.get_writer(path, fps=fps, macro_block_size=2, quality=8) as writer:
        for frame in frames[:, :height, :width].numpy():
            writer.append_data(frame)
    return path


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
