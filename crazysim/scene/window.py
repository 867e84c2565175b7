"""A window of the program's own: it draws when told to, in the thread that asks, and the mouse turns the view."""

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

    MuJoCo's own passive viewer draws in a thread of its own, and ends the process with a fault now and then when it
    is closed; here everything happens within ``draw``.
    """

    def __init__(self, model: mujoco.MjModel, max_geom: int, width: int, height: int):
        """Open the window.

        Raises:
            RenderError: If there is no screen, or no window can be opened on it.
        """
        self._model = model
        self._glfw = glfw = _glfw()
        # A process that also draws in memory with EGL cannot have contexts of two kinds current in one thread.
        egl = os.environ.get("MUJOCO_GL", "").lower() == "egl"
        glfw.window_hint(glfw.CONTEXT_CREATION_API, glfw.EGL_CONTEXT_API if egl else glfw.NATIVE_CONTEXT_API)
        glfw.window_hint(glfw.VISIBLE, True)
        glfw.window_hint(glfw.SAMPLES, model.vis.quality.offsamples)
        with warnings.catch_warnings(action="ignore"):  # GLFW's warning and an error would say one thing twice
            self._window = glfw.create_window(width, height, "crazysim", None, None)
        glfw.default_window_hints()
        if not self._window:
            raise RenderError("no window could be opened; without a working screen use mode='rgb_array'")
        glfw.make_context_current(self._window)
        glfw.swap_interval(0)  # a simulation that draws often must not wait for the screen
        self._context: Any = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        self._scene = mujoco.MjvScene(model, max_geom)
        self._option = mujoco.MjvOption()
        self._camera = mujoco.MjvCamera()
        self._asked: Any = None
        self._size = (width, height)
        self._cursor = (0.0, 0.0)
        glfw.set_cursor_pos_callback(self._window, self._on_move)
        glfw.set_scroll_callback(self._window, self._on_scroll)

    @property
    def is_open(self) -> bool:
        """Whether the window is there; false once its user or ``close`` has closed it."""
        return self._window is not None

    def draw(self, data: mujoco.MjData, camera: mujoco.MjvCamera, overlays: Overlays, width: int, height: int) -> None:
        """Show ``data``; a camera or a size other than at the last call is taken over, the mouse does the rest."""
        glfw = self._glfw
        if self._window is not None and glfw.window_should_close(self._window):
            self.close()
        if self._window is None:
            return
        asked = _settings(camera)
        if asked != self._asked:
            self._asked, self._camera = asked, camera
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
        """Close the window and free what it held."""
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
            "render('human') needs a screen, and neither DISPLAY nor WAYLAND_DISPLAY is set; without a screen use "
            "mode='rgb_array'"
        )
    import glfw  # comes with mujoco; pictures in memory do without

    with warnings.catch_warnings(action="ignore"):
        works = glfw.init()
    if not works:
        raise RenderError("no screen can be reached (GLFW does not start); without a screen use mode='rgb_array'")
    return glfw


def _settings(camera: mujoco.MjvCamera) -> tuple:
    names = ("type", "fixedcamid", "trackbodyid", "distance", "azimuth", "elevation", "orthographic")
    return (*(getattr(camera, name) for name in names), *camera.lookat)
