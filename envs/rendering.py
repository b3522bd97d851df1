"""Pictures of batched simulations: OpenGL backends, cameras and the renderer.

MuJoCo fixes its OpenGL backend when it is imported, from ``MUJOCO_GL``, and without that variable
takes the one that needs a display. Here the backend is chosen at the first picture: the one that
``MUJOCO_GL`` names by then, otherwise the first that works, which is then written to ``MUJOCO_GL``.
"""

from __future__ import annotations

import atexit
import copy
import dataclasses
import functools
import importlib
import itertools
import os
import platform
import sys
import weakref
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from mujoco.batch import Batch

TRAIL_RADIUS = 0.04
"""Half the width of a trail, metres."""

_DISABLED = ("disable", "disabled", "off", "false", "0")
_MAX_GEOMS = 20_000
_INSTALL = (
    "Install a backend that needs no display: on Debian and Ubuntu `apt-get install libegl1 "
    "libegl-mesa0 libgl1-mesa-dri`, or `apt-get install libosmesa6` and set MUJOCO_GL=osmesa."
)


def _backends() -> tuple[str, ...]:
    """Modules of MuJoCo to try in turn for an OpenGL context."""
    asked = os.environ.get("MUJOCO_GL", "").lower().strip()
    if asked in _DISABLED:
        return ()
    if asked in ("egl", "osmesa", "glfw", "cgl"):
        return (asked,)
    if platform.system() == "Linux":
        display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
        return ("egl", "osmesa", "glfw") if display else ("egl", "osmesa")
    return ("cgl", "glfw") if platform.system() == "Darwin" else ("glfw",)


def _try_backend(name: str) -> type:
    """Import a backend and open MuJoCo's drawing context once, or undo the import and raise."""
    before = {key: os.environ.get(key) for key in ("MUJOCO_GL", "PYOPENGL_PLATFORM")}
    loaded = set(sys.modules)
    try:
        # MuJoCo's C library reads it to find the driver's functions; child processes inherit it.
        os.environ["MUJOCO_GL"] = name
        context_type = importlib.import_module(f"mujoco.{name}").GLContext
        context = context_type(16, 16)
        context.make_current()
        # GLFW without a display fails only here.
        mujoco.MjrContext(mujoco.MjModel.from_xml_string("<mujoco/>"), 50).free()
        context.free()
    except BaseException:
        # PyOpenGL binds itself to one platform when it is imported: without this, a failure of EGL
        # would rule OSMesa out.
        for module in set(sys.modules) - loaded:
            if module.split(".")[0] == "OpenGL" or module.startswith(f"mujoco.{name}"):
                del sys.modules[module]
        for key, value in before.items():
            os.environ.pop(key, None)
            if value is not None:
                os.environ[key] = value
        raise
    return context_type


@functools.cache
def gl_context_type() -> type:
    """The class of OpenGL contexts of the backend in use; it is chosen at the first call.

    Returns:
        MuJoCo's ``GLContext`` of the backend that ``MUJOCO_GL`` names; if that is unset, of the
        first that works of EGL, OSMesa and (with a display) GLFW.

    Raises:
        RuntimeError: if none works. The message has the reason for each and what to install.
    """
    failures = []
    for name in _backends():
        try:
            context_type = _try_backend(name)
            _owner.append(os.getpid())
            # After the backend's own handler is registered, so that this one runs before it.
            atexit.register(_close_all)
            return context_type
        except Exception as error:  # whatever a driver or a loader raises
            failures.append(f"{name}: {type(error).__name__}: {error}")
    asked = os.environ.get("MUJOCO_GL")
    reasons = "; ".join(failures) or "rendering is switched off"
    raise RuntimeError(f"No OpenGL backend works (MUJOCO_GL={asked!r}): {reasons}. {_INSTALL}")


_owner: list[int] = []
"""The process that opened the driver, once there is one: what it holds does not survive a fork."""
_inherited: list[Any] = []
"""Contexts of the parent of a forked process. Freeing one hangs, so nothing may collect them."""
_open_renderers: weakref.WeakSet[Renderer] = weakref.WeakSet()


def _is_forked() -> bool:
    """Whether this process was forked from one that had opened the driver."""
    return bool(_owner) and _owner[0] != os.getpid()


def _close_all() -> None:
    """Release what is still open at exit, while the modules that release it exist."""
    for renderer in list(_open_renderers):
        renderer.close()


@dataclasses.dataclass(frozen=True)
class Camera:
    """A view of the world: where the camera looks at, and from where.

    Args:
        lookat: the point in the middle of the picture, metres.
        azimuth: direction in which the camera looks, degrees from the x axis.
        elevation: angle of that direction above the horizon, degrees; -90 looks straight down.
        distance: of the camera from ``lookat``, metres.
        fovy: vertical field of view, degrees.
        height: if given, the projection is orthographic and shows this many metres vertically.
    """

    lookat: tuple[float, float, float]
    azimuth: float = 90.0
    elevation: float = -90.0
    distance: float = 10.0
    fovy: float = 50.0
    height: float | None = None


def _simplify(points: np.ndarray, tolerance: float) -> np.ndarray:
    """Leave out points ``[T, 2]`` within a tolerance of the path: drawing costs by the piece."""
    if len(points) < 2:
        return points
    kept = [0]
    for last in range(2, len(points)):
        start, between = points[kept[-1]], points[kept[-1] + 1 : last]
        chord = points[last] - start
        share = np.clip((between - start) @ chord / max(chord @ chord, 1e-12), 0.0, 1.0)
        if np.abs(between - start - share[:, None] * chord).max() > tolerance:
            kept.append(last - 1)
    return points[[*kept, len(points) - 1]]


class Renderer:
    """Draws the simulations of a batch.

    The scene, the copies of model and data, and what the graphics memory holds are made once; a
    picture costs the transfer of one simulation, and the drawing. Shadows are off: they are most
    of the cost in software rendering.

    Args:
        batch: the simulations. Sizes that differ between them are drawn as they are.
        samples: samples per pixel against jagged edges; 0 draws fastest.

    Raises:
        RuntimeError: if no OpenGL backend works, see :func:`gl_context_type`; at the first picture, in a
            process that was forked after its parent had drawn one.
    """

    def __init__(self, batch: Batch, *, samples: int = 4) -> None:
        self._gl = self._context = None
        self._batch = batch
        self._model = copy.copy(batch.model)
        self._data = mujoco.MjData(self._model)
        self._scene = mujoco.MjvScene(self._model, maxgeom=_MAX_GEOMS)
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            self._scene.flags[flag] = False
        self._option = mujoco.MjvOption()
        self._samples = samples
        self._size = (0, 0)

    def _make_current(self, width: int, height: int) -> None:
        """Activate a context whose buffer holds pictures of this size."""
        if _is_forked():
            raise RuntimeError(
                "This process was forked after its parent had drawn a picture, which OpenGL does not "
                "survive: start it with spawn, as ParallelEnv(..., mp_start_method='spawn') or "
                "multiprocessing.get_context('spawn')."
            )
        if self._gl is None:
            self._gl = gl_context_type()(width, height)
            _open_renderers.add(self)
        self._gl.make_current()
        if self._context is None:
            self._model.vis.quality.offsamples = self._samples
            self._model.vis.global_.offwidth = width
            self._model.vis.global_.offheight = height
            self._context = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_100)
            mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
            self._size = (width, height)
        grown = (max(width, self._size[0]), max(height, self._size[1]))
        if grown != self._size:
            mujoco.mjr_resizeOffscreen(*grown, self._context)
            self._size = grown

    def render(
        self,
        index: int,
        camera: Camera | str,
        width: int,
        height: int,
        trails: Sequence[tuple[Any, Sequence[float]]] = (),
    ) -> np.ndarray:
        """Draw one simulation.

        Args:
            index: which one.
            camera: a view, or the name of a camera of the model.
            width: of the picture, pixels.
            height: of the picture, pixels.
            trails: see :meth:`PixelsMixin.render`.

        Returns:
            The picture, ``uint8 [height, width, 3]``.

        Raises:
            ValueError: for a camera that the model does not have, or trails that are too long.
        """
        self._make_current(width, height)
        model, data = self._batch.get_model(index, self._model), self._data
        mujoco.mj_fwdPosition(model, self._batch.get_data(index, data))
        view = self._aim(camera)
        everything = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(model, data, self._option, None, view, everything, self._scene)
        for points, rgb in trails:
            self._add_trail(points, rgb)
        picture = np.empty((height, width, 3), dtype=np.uint8)
        rect = mujoco.MjrRect(0, 0, width, height)
        mujoco.mjr_render(rect, self._scene, self._context)
        mujoco.mjr_readPixels(picture, None, rect, self._context)
        return picture[::-1]  # OpenGL counts rows from the bottom

    def _aim(self, camera: Camera | str) -> mujoco.MjvCamera:
        view = mujoco.MjvCamera()
        if isinstance(camera, str):
            view.type = mujoco.mjtCamera.mjCAMERA_FIXED
            view.fixedcamid = mujoco.mj_name2id(self._model, mujoco.mjtObj.mjOBJ_CAMERA, camera)
            if view.fixedcamid < 0:
                names = [self._model.camera(i).name for i in range(self._model.ncam)]
                raise ValueError(f"Unknown camera {camera!r}; the model has {names}.")
            return view
        view.type = mujoco.mjtCamera.mjCAMERA_FREE
        view.lookat[:] = camera.lookat
        view.azimuth, view.elevation = camera.azimuth, camera.elevation
        view.distance = camera.distance
        view.orthographic = camera.height is not None
        # For an orthographic camera MuJoCo reads this as metres.
        self._model.vis.global_.fovy = camera.fovy if camera.height is None else camera.height
        return view

    def _add_trail(self, points: Any, rgb: Sequence[float]) -> None:
        points = np.asarray(points, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 2 or len(rgb) != 3:
            raise ValueError(
                f"A trail is (xy [T, 2], (red, green, blue)), got shapes {points.shape} and "
                f"({len(rgb)},)."
            )
        kept = _simplify(points[np.isfinite(points).all(-1)], TRAIL_RADIUS / 16)
        if self._scene.ngeom + len(kept) > self._scene.maxgeom:
            raise ValueError(f"The trails have more points than the {_MAX_GEOMS} that fit a scene.")
        rgba = np.array([*rgb, 1.0], dtype=np.float32)
        capsule, zero = mujoco.mjtGeom.mjGEOM_CAPSULE, np.zeros(3)
        ends = [np.append(point, TRAIL_RADIUS) for point in kept]
        for start, end in itertools.pairwise(ends):
            geom = self._scene.geoms[self._scene.ngeom]
            mujoco.mjv_initGeom(geom, capsule, zero, zero, np.zeros(9), rgba)
            mujoco.mjv_connector(geom, capsule, TRAIL_RADIUS, start, end)
            geom.emission = 0.15  # the colour of a trail is its legend: keep it free of shading
            self._scene.ngeom += 1

    def close(self) -> None:
        """Release the graphics memory. The next picture takes it again."""
        context, gl = self._context, self._gl
        self._context = self._gl = None
        if _is_forked():
            _inherited.append((context, gl))
        elif gl is not None:
            if context is not None:
                gl.make_current()
                context.free()
            gl.free()

    def __del__(self) -> None:
        self.close()
