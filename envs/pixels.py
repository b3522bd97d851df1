"""Pictures as a part of a batched environment."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import torch
from mujoco.batch import Batch
from numpy.typing import ArrayLike
from torch import Tensor
from torchrl.data import Bounded

from torchrl_morl.evaluation.overlay import draw_preference

from .fields import shown
from .rendering import Camera, Renderer


class PixelsMixin:
    """Rendering of :class:`envs.BatchedMujocoEnv`: :meth:`render`, and the ``pixels`` observation.

    Nothing here is opened before the first picture, so that environments without pictures need no
    OpenGL. Subclasses add views of their own by overriding :meth:`_camera`.
    """

    batch: Batch
    model: mujoco.MjModel
    num_envs: int
    device: torch.device | None

    _renderer: Renderer | None = None
    _pixels: Tensor

    def _init_pixels(
        self, from_pixels: bool, width: int, height: int, camera: str | Camera
    ) -> None:
        if not isinstance(camera, (str, Camera)):
            raise ValueError(f"camera must be a name or an envs.Camera, got {shown(camera)}.")
        self.from_pixels = from_pixels
        self.render_width = width
        self.render_height = height
        self.camera = camera
        if from_pixels:
            self._pixels = torch.zeros(self.num_envs, height, width, 3, dtype=torch.uint8)

    def _pixels_spec(self) -> Bounded:
        return Bounded(0, 255, shape=self._pixels.shape, dtype=torch.uint8)

    def _camera(self, camera: str | Camera, index: int, aspect: float) -> Camera | str:
        """The view of environment ``index`` that a name stands for.

        Args:
            camera: what :meth:`render` was given.
            index: the environment.
            aspect: width of the picture over its height.

        Returns:
            A view, or the name of a camera of the model.
        """
        del index
        if camera != "overview":
            return camera
        stat = self.model.stat
        centre = tuple(float(x) for x in stat.center)
        distance = 2.0 * float(stat.extent) / min(1.0, aspect)
        return Camera(centre, azimuth=90.0, elevation=-45.0, distance=distance)

    def render(
        self,
        *,
        camera: str | Camera | None = None,
        width: int | None = None,
        height: int | None = None,
        ids: Sequence[int] | Tensor | None = None,
        preference: Tensor | Sequence | None = None,
        names: Sequence[str] | None = None,
        colors: ArrayLike | None = None,
        trails: Sequence[tuple[Any, Sequence[float]]] = (),
    ) -> Tensor:
        """Draw the current state.

        Keyword Args:
            camera: a name or a :class:`envs.Camera`; defaults to that of the environment.
            width: of a picture, pixels; defaults to ``render_width``.
            height: of a picture, pixels; defaults to ``render_height``.
            ids: the ``n`` environments to draw; defaults to all.
            preference: ``[n, T]`` or ``[T]``, drawn as a bar chart.
            names: of the ``T`` objectives of the preference.
            colors: of its bars, ``[T, 3]``, red, green and blue from 0 to 1.
            trails: paths on the floor, as pairs of positions ``[T, 2]`` (metres; rows that are not
                finite are left out) and a colour (red, green and blue from 0 to 1). They are drawn
                in every picture: give ``ids`` to draw different trails for each environment.

        Returns:
            Pictures ``uint8 [n, height, width, 3]``, on the device of the environment.

        Raises:
            RuntimeError: if no OpenGL backend works; the message says what to install. Also in a
                process that was forked after its parent had drawn: start it with spawn.
            ValueError: for an unknown camera, environments that do not exist, a preference without
                names, or trails of a wrong shape.
        """
        width = self.render_width if width is None else width
        height = self.render_height if height is None else height
        rows = range(self.num_envs) if ids is None else torch.as_tensor(ids).flatten().tolist()
        if any(not 0 <= row < self.num_envs for row in rows):
            raise ValueError(f"ids must be in 0 ... {self.num_envs - 1}, got {list(rows)}.")
        if preference is not None and names is None:
            raise ValueError("A preference needs names for its bars, e.g. names=space.tunable.")
        if self._renderer is None:
            self._renderer = Renderer(self.batch)
        camera = self.camera if camera is None else camera
        frames = torch.zeros(len(rows), height, width, 3, dtype=torch.uint8)
        for frame, row in zip(frames.numpy(), rows, strict=True):
            view = self._camera(camera, row, width / height)
            frame[...] = self._renderer.render(row, view, width, height, trails)
        if preference is not None:
            frames = draw_preference(frames, torch.as_tensor(preference), names, colors=colors)
        return frames.to(self.device) if self.device is not None else frames

    def _observe_pixels(self, ids: Tensor | None) -> Tensor:
        """Draw the environments ``ids`` anew, and remember the pictures for partial resets."""
        rows = slice(None) if ids is None else ids
        self._pixels[rows] = self.render(ids=ids).cpu()
        return self._pixels[rows].clone()

    def _close_renderer(self) -> None:
        if self._renderer is not None:
            self._renderer.close()
        self._renderer = None
