"""Pictures of one world, in memory or in a window."""

from __future__ import annotations

import weakref
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from crazysim.errors import ConfigError, RenderError, UnknownNameError
from crazysim.scene.overlays import Overlays
from crazysim.scene.window import Window

MAX_SIZES = 4
"""How many picture sizes keep a context of their own."""

MODES = ("human", "rgb_array", "depth_array", "rgbd_tuple")


class Viewer:
    """Draws ``mj_data`` of one model: offscreen in any size, or in a window. Contexts are made at first use."""

    def __init__(self, mj_model: mujoco.MjModel, mj_data: mujoco.MjData, max_geom: int):
        """Keep the model; nothing is opened yet."""
        self._model, self._data, self._max_geom = mj_model, mj_data, max_geom
        self._renderers: dict[tuple[int, int], mujoco.Renderer] = {}
        self._windows: list[Window] = []
        # Contexts must go before the interpreter does, also where nobody calls close.
        weakref.finalize(self, _free, self._renderers, self._windows)

    def render(
        self,
        mode: str,
        camera: int | str,
        cam_config: dict[str, Any] | None,
        width: int,
        height: int,
        overlays: Overlays,
    ) -> NDArray | tuple[NDArray, NDArray] | None:
        """Return the picture that ``Sim.render`` documents."""
        if mode not in MODES:
            raise UnknownNameError(f"unknown render mode {mode!r}; the modes are {', '.join(MODES)}")
        require_size(width, height)
        cam = self._camera(camera, cam_config)
        if mode == "human":
            if not self._windows:
                self._windows.append(Window(self._model, self._max_geom, width, height))
            self._windows[0].draw(self._data, cam, overlays, width, height)
            return None
        renderer = self._renderer(width, height)
        # Twice: MuJoCo lays endless floors out around the camera of the update before.
        renderer.update_scene(self._data, camera=cam)
        renderer.update_scene(self._data, camera=cam)
        bodies = renderer.scene.ngeom
        overlays.write(renderer.scene)
        if mode == "rgb_array":
            return _picture(renderer, overlays)
        color = _picture(renderer, overlays) if mode == "rgbd_tuple" else None
        renderer.scene.ngeom = bodies  # overlays are paint: no distance is measured to them
        renderer.enable_depth_rendering()
        depth = renderer.render().copy()
        renderer.disable_depth_rendering()
        return depth if color is None else (color, depth)

    def close(self) -> None:
        """Close the window and free the contexts."""
        _free(self._renderers, self._windows)

    def _camera(self, camera: int | str, cam_config: dict[str, Any] | None) -> mujoco.MjvCamera:
        cam = mujoco.MjvCamera()
        number = camera_id(self._model, camera)
        if number >= 0:
            cam.type, cam.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, number
            return cam
        mujoco.mjv_defaultFreeCamera(self._model, cam)
        for key, value in (cam_config or {}).items():
            if not hasattr(cam, key):
                raise UnknownNameError(f"a camera has no setting {key!r}; use lookat, distance, azimuth, elevation")
            try:
                setattr(cam, key, value if np.ndim(value) == 0 else np.asarray(value, float))
            except (TypeError, ValueError) as error:
                raise ConfigError(f"the camera's {key} cannot be {value!r}") from error
        return cam

    def _renderer(self, width: int, height: int) -> mujoco.Renderer:
        if (width, height) not in self._renderers:
            buffers = self._model.vis.global_
            # Buffers are made once per context; a larger picture than any before needs a context of its own.
            buffers.offwidth, buffers.offheight = max(buffers.offwidth, width), max(buffers.offheight, height)
            try:
                renderer = mujoco.Renderer(self._model, height, width, self._max_geom, font_scale(height))
            except Exception as error:  # the OpenGL bindings raise whatever they like
                raise RenderError(
                    f"no OpenGL context could be made ({type(error).__name__}: {error}). On a machine without a "
                    f"screen set MUJOCO_GL=egl and install libegl1 and Mesa's drivers (Debian: apt-get install "
                    f"libegl1 libgl1-mesa-dri)."
                ) from error
            self._renderers[width, height] = renderer
            if len(self._renderers) > MAX_SIZES:
                self._renderers.pop(next(iter(self._renderers))).close()
        return self._renderers[width, height]


def camera_id(model: mujoco.MjModel, camera: int | str) -> int:
    """Return the number of a camera, -1 for the free one.

    Raises:
        UnknownNameError: If there is none of that name or number.
    """
    if isinstance(camera, str):
        number = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, camera)
        if number < 0:
            names = [model.camera(i).name for i in range(model.ncam)]
            raise UnknownNameError(f"the scene has no camera {camera!r}; it has {', '.join(names[:12])}, or -1")
        return number
    if not isinstance(camera, (int, np.integer)) or not -1 <= camera < model.ncam:
        raise UnknownNameError(
            f"camera {camera!r} does not exist; ids go from 0 to {model.ncam - 1}, -1 is the free camera"
        )
    return int(camera)


def require_size(width: Any, height: Any) -> None:
    """Check the size of a picture.

    Raises:
        ConfigError: If it is no size.
    """
    if not all(isinstance(n, (int, np.integer)) and n > 0 for n in (width, height)):
        raise ConfigError(
            f"a picture of {width} x {height} pixels cannot be; width and height must be positive whole numbers"
        )


def font_scale(height: int) -> mujoco.mjtFontScale:
    """Return the size of MuJoCo's font at which text is as readable in a small picture as in a large one."""
    return mujoco.mjtFontScale(int(np.clip(50 * (height // 240), 50, 300)))


def _picture(renderer: mujoco.Renderer, overlays: Overlays) -> NDArray:
    picture = renderer.render().copy()
    if overlays.has_text:  # the renderer knows no text: it is written over what is still in its buffer, and read again
        overlays.write_text(renderer._rect, renderer._mjr_context)
        mujoco.mjr_readPixels(picture, None, renderer._rect, renderer._mjr_context)
        picture = np.flipud(picture).copy() if renderer._gl_context else picture
    return picture


def _free(renderers: dict[tuple[int, int], mujoco.Renderer], windows: list[Window]) -> None:
    for holder in (*renderers.values(), *windows):
        holder.close()
    renderers.clear()
    windows.clear()
