"""Images of one world, in memory or in a window."""

from __future__ import annotations

import os
import weakref
from collections.abc import Mapping

import mujoco
import numpy as np
from mujoco.rendering.classic import gl_context
from numpy.typing import ArrayLike, NDArray

from crazysim import startup
from crazysim.core.settings import check_image_size
from crazysim.errors import ConfigError, RenderError, UnknownNameError, expect, require, short_repr
from crazysim.scene.overlays import Overlays
from crazysim.scene.scene_window import SceneWindow
from crazysim.scene.software import rendering_quality

MAX_MATERIALS = 998
"""Largest number of materials of a scene that MuJoCo draws (``mjMAXMATERIAL``, 1000, less two)."""
MAX_SIZES = 4
"""Largest number of image sizes for which OpenGL contexts are kept."""

FREE_CAMERA_SHAPES = {"lookat": (3,), "distance": (), "azimuth": (), "elevation": ()}
"""Shapes of the settings of the free camera, which ``cam_config`` may contain."""

RENDER_MODES = ("human", "rgb_array", "depth_array", "rgbd_tuple")
"""Modes of ``Sim.render``."""


class ModelRenderer:
    """Renderer of one model: offscreen in any size, or in a window. Contexts are made when first used."""

    def __init__(self, mj_model: mujoco.MjModel, mj_data: mujoco.MjData, max_geom: int):
        self._model, self._data, self._max_geom = mj_model, mj_data, max_geom
        self._renderers: dict[tuple[int, int], mujoco.Renderer] = {}
        self._windows: list[SceneWindow] = []
        # Contexts must be freed before the interpreter exits, even without a call of close.
        weakref.finalize(self, _close_all, self._renderers, self._windows)

    def render(
        self,
        mode: str,
        camera: int | str,
        cam_config: Mapping[str, ArrayLike] | None,
        width: int,
        height: int,
        overlays: Overlays,
    ) -> NDArray | tuple[NDArray, NDArray] | None:
        """Return or show an image; see ``Sim.render``."""
        require(
            isinstance(mode, str) and mode in RENDER_MODES,
            f"expected mode {' or '.join(map(repr, RENDER_MODES))}, got {mode!r}",
            UnknownNameError,
        )
        check_image_size(width, height)
        require(
            self._model.nmat <= MAX_MATERIALS,
            f"expected at most {MAX_MATERIALS} materials in a scene that is drawn, got {self._model.nmat}. Use "
            f"rgba= instead of materials for objects of one colour, or fewer drones: the LEDs of a drone take two.",
            RenderError,
        )
        cam = self._camera(camera, cam_config)
        if mode == "human":
            if not self._windows:
                self._windows.append(SceneWindow(self._model, self._max_geom, width, height))
            self._windows[0].draw(self._data, cam, overlays, width, height)
            return None
        renderer = self._renderer(width, height)
        try:
            return self._draw(renderer, mode, cam, overlays)
        finally:
            _release_context()

    def _draw(
        self, renderer: mujoco.Renderer, mode: str, cam: mujoco.MjvCamera, overlays: Overlays
    ) -> NDArray | tuple[NDArray, NDArray]:
        # Twice: MuJoCo centres infinite planes on the camera of the previous update.
        renderer.update_scene(self._data, camera=cam)
        renderer.update_scene(self._data, camera=cam)
        n_scene_geoms = renderer.scene.ngeom
        overlays.write(renderer.scene)
        if mode == "rgb_array":
            return _read_image(renderer, overlays)
        color = _read_image(renderer, overlays) if mode == "rgbd_tuple" else None
        renderer.scene.ngeom = n_scene_geoms  # depth does not include overlays
        renderer.enable_depth_rendering()
        depth = renderer.render().copy()
        renderer.disable_depth_rendering()
        return depth if color is None else (color, depth)

    def close(self) -> None:
        _close_all(self._renderers, self._windows)

    def _camera(self, camera: int | str, cam_config: Mapping[str, ArrayLike] | None) -> mujoco.MjvCamera:
        cam = mujoco.MjvCamera()
        index = camera_id(self._model, camera)
        if index >= 0:
            cam.type, cam.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, index
            return cam
        mujoco.mjv_defaultFreeCamera(self._model, cam)
        expect(
            cam_config is None or isinstance(cam_config, Mapping),
            "cam_config as a dict",
            cam_config,
            "Use {'lookat': (0, 0, 1), 'distance': 3.0}.",
        )
        for key, value in (cam_config or {}).items():
            if key not in FREE_CAMERA_SHAPES:  # wrong values of other fields can make MuJoCo end the process
                names = ", ".join(FREE_CAMERA_SHAPES)
                raise UnknownNameError(f"expected names among {names} in cam_config, got {short_repr(key)}")
            try:
                numbers = np.asarray(value, float)
            except (TypeError, ValueError):
                numbers = np.array(np.nan)
            if numbers.shape != FREE_CAMERA_SHAPES[key] or not np.isfinite(numbers).all():
                raise ConfigError(
                    f"expected numbers for {key} of the camera, {3 if FREE_CAMERA_SHAPES[key] else 1} and finite, got "
                    f"{short_repr(value)}"
                )
            setattr(cam, key, numbers if numbers.ndim else float(numbers))
        return cam

    def _renderer(self, width: int, height: int) -> mujoco.Renderer:
        if (width, height) not in self._renderers:
            buffers = self._model.vis.global_
            # A context's buffers have a fixed size; an image larger than all previous images needs a new context.
            sizes_before = buffers.offwidth, buffers.offheight
            buffers.offwidth, buffers.offheight = max(buffers.offwidth, width), max(buffers.offheight, height)
            try:
                with rendering_quality(self._model):
                    renderer = mujoco.Renderer(self._model, height, width, self._max_geom, font_scale(height))
            except ConfigError:
                raise
            except Exception as error:  # OpenGL bindings raise errors of any type
                buffers.offwidth, buffers.offheight = sizes_before
                size_message = (
                    f"expected an image of a size that OpenGL can draw here, got {width} x {height} pixels: {error}. "
                    f"Use a smaller one."
                )
                raise RenderError(size_message if "framebuffer" in str(error) else _opengl_message(error)) from error
            self._renderers[width, height] = renderer
            if len(self._renderers) > MAX_SIZES:
                self._renderers.pop(next(iter(self._renderers))).close()
        return self._renderers[width, height]


def _opengl_message(error: Exception) -> str:
    wanted = startup.refused_variables.get("MUJOCO_GL", os.environ.get("MUJOCO_GL", ""))
    context = getattr(gl_context, "GLContext", None)
    if context is None or context.__module__ == gl_context.__name__:  # a placeholder
        return f"expected a MUJOCO_GL with which MuJoCo can draw, got {wanted!r}. Use MUJOCO_GL=egl."
    if wanted.lower() == "egl" and not context.__module__.endswith("egl"):
        return (
            f"expected MuJoCo to draw with MUJOCO_GL=egl, got {context.__module__}: MuJoCo was imported before the "
            f"variable was set. Import crazysim before mujoco, or set MUJOCO_GL=egl before Python starts."
        )
    return (
        f"expected a working OpenGL, got {type(error).__name__}: {error}. On a machine without a screen set "
        f"MUJOCO_GL=egl and install libegl1 and Mesa's drivers (Debian: apt-get install libegl1 libgl1-mesa-dri)."
    )


def camera_id(model: mujoco.MjModel, camera: int | str) -> int:
    """Return the id of a camera, -1 for the free camera."""
    if isinstance(camera, str):
        index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, camera)
        if index < 0:
            names = [model.camera(i).name for i in range(model.ncam)]
            raise UnknownNameError(f"expected -1 or a camera of the scene, {', '.join(names[:12])}, got {camera!r}")
        return index
    require(
        isinstance(camera, (int, np.integer)) and -1 <= camera < model.ncam,
        f"expected a camera id from 0 to {model.ncam - 1}, or -1 for the free camera, got {camera!r}",
        UnknownNameError,
    )
    return int(camera)


def font_scale(height: int) -> mujoco.mjtFontScale:
    """Return the scale of MuJoCo's font for an image height, pixels."""
    return mujoco.mjtFontScale(int(np.clip(50 * (height // 240), 50, 300)))


def _read_image(renderer: mujoco.Renderer, overlays: Overlays) -> NDArray:
    image = renderer.render().copy()
    if overlays.has_text:  # mujoco.Renderer draws no text: write it into the buffer and read that again
        overlays.write_text(renderer._rect, renderer._mjr_context)
        mujoco.mjr_readPixels(image, None, renderer._rect, renderer._mjr_context)
        image = np.flipud(image).copy() if renderer._gl_context else image
    return image


def _close_all(renderers: dict[tuple[int, int], mujoco.Renderer], windows: list[SceneWindow]) -> None:
    for resource in (*renderers.values(), *windows):
        resource.close()
    renderers.clear()
    windows.clear()


def _release_context() -> None:
    # While a context is current in one thread, even after that thread has ended, no other thread can use or free it.
    # The garbage collector, which runs in any thread, must be able to free renderers.
    backend = gl_context.GLContext.__module__
    if backend == "mujoco.egl":
        from OpenGL import EGL

        EGL.eglReleaseThread()
    elif backend == "mujoco.glfw":
        import glfw

        glfw.make_context_current(None)  # type: ignore[arg-type]
