"""A window that draws within ``draw``, in the thread of its caller, and whose view the mouse moves."""

from __future__ import annotations

import os
import sys
import warnings
from typing import Any

import mujoco

from crazysim.errors import RenderError
from crazysim.scene.overlays import Overlays


class Window:
    """A window that shows one model.

    MuJoCo's passive viewer draws in a thread of its own, and sometimes crashes the process when it is closed.
    """

    def __init__(self, model: mujoco.MjModel, max_geom: int, width: int, height: int):
        """Open the window.

        Raises:
            RenderError: If there is no screen, or no window can be opened on it.
        """
        self._model = model
        self._glfw = glfw = _glfw()
        # A thread cannot use an EGL context for images in memory beside one of another kind.
        egl = os.environ.get("MUJOCO_GL", "").lower() == "egl"
        glfw.window_hint(glfw.CONTEXT_CREATION_API, glfw.EGL_CONTEXT_API if egl else glfw.NATIVE_CONTEXT_API)
        glfw.window_hint(glfw.VISIBLE, True)
        glfw.window_hint(glfw.SAMPLES, model.vis.quality.offsamples)
        with warnings.catch_warnings(action="ignore"):  # the error below replaces GLFW's warning
            self._window = glfw.create_window(width, height, "crazysim", None, None)
        glfw.default_window_hints()
        if not self._window:
            raise RenderError("expected a screen that can open a window, got none. Use mode='rgb_array' without one.")
        glfw.make_context_current(self._window)
        glfw.swap_interval(0)  # a simulation that draws often must not wait for the screen
        self._context: Any = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        self._scene = mujoco.MjvScene(model, max_geom)
        self._option = mujoco.MjvOption()
        self._camera = mujoco.MjvCamera()
        self._settings: Any = None
        self._size = (width, height)
        self._cursor = (0.0, 0.0)
        glfw.set_cursor_pos_callback(self._window, self._on_move)
        glfw.set_scroll_callback(self._window, self._on_scroll)

    @property
    def is_open(self) -> bool:
        """True until the user or ``close`` closes the window."""
        return self._window is not None

    def draw(self, data: mujoco.MjData, camera: mujoco.MjvCamera, overlays: Overlays, width: int, height: int) -> None:
        """Show ``data``. A camera or size that differs from the last call replaces the view that the mouse has set."""
        glfw = self._glfw
        if self._window is not None and glfw.window_should_close(self._window):
            self.close()
        if self._window is None:
            return
        settings = _settings(camera)
        if settings != self._settings:
            self._settings, self._camera = settings, camera
        if (width, height) != self._size:
            self._size = (width, height)
            glfw.set_window_size(self._window, width, height)
        glfw.poll_events()
        mujoco.mjv_updateScene(
            self._model, data, self._option, None, self._camera, mujoco.mjtCatBit.mjCAT_ALL, self._scene
        )
        overlays.write(self._scene)
        glfw.make_context_current(self._window)
        pixels = mujoco.MjrRect(0, 0, *glfw.get_framebuffer_size(self._window))
        mujoco.mjr_render(pixels, self._scene, self._context)
        overlays.write_text(pixels, self._context)
        glfw.swap_buffers(self._window)

    def close(self) -> None:
        """Close the window and free its context."""
        if self._window is None:
            return
        self._glfw.make_context_current(self._window)
        self._context.free()
        self._glfw.destroy_window(self._window)
        self._window = None

    def _on_move(self, window: Any, x: float, y: float) -> None:
        glfw, mouse = self._glfw, mujoco.mjtMouse
        dx, dy = x - self._cursor[0], y - self._cursor[1]
        self._cursor = (x, y)
        actions = {
            glfw.MOUSE_BUTTON_LEFT: mouse.mjMOUSE_ROTATE_V,
            glfw.MOUSE_BUTTON_RIGHT: mouse.mjMOUSE_MOVE_V,
            glfw.MOUSE_BUTTON_MIDDLE: mouse.mjMOUSE_ZOOM,
        }
        for button, action in actions.items():
            if glfw.get_mouse_button(window, button) == glfw.PRESS:
                self._move(action, dx / max(self._size[1], 1), dy / max(self._size[1], 1))

    def _on_scroll(self, _window: Any, _dx: float, dy: float) -> None:
        self._move(mujoco.mjtMouse.mjMOUSE_ZOOM, 0.0, -0.05 * dy)

    def _move(self, action: mujoco.mjtMouse, dx: float, dy: float) -> None:
        mujoco.mjv_moveCamera(self._model, action, dx, dy, self._camera)


def _glfw() -> Any:
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise RenderError(
            "expected a screen for render('human'), got neither DISPLAY nor WAYLAND_DISPLAY. Use mode='rgb_array' "
            "without a screen."
        )
    import glfw  # comes with mujoco; images in memory do not need it

    with warnings.catch_warnings(action="ignore"):
        works = glfw.init()
    if not works:
        raise RenderError("expected a screen, got one that GLFW cannot reach. Use mode='rgb_array' without a screen.")
    return glfw


def _settings(camera: mujoco.MjvCamera) -> tuple:
    names = ("type", "fixedcamid", "trackbodyid", "distance", "azimuth", "elevation", "orthographic")
    return (*(getattr(camera, name) for name in names), *camera.lookat)
