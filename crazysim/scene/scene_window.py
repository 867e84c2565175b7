"""A window that draws in the caller's thread, with a camera that the mouse moves."""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from crazysim.errors import RenderError, require
from crazysim.scene.overlays import Overlays

KEY_NAMES = {
    "UP": "up", "DOWN": "down", "LEFT": "left", "RIGHT": "right", "SPACE": "space", "TAB": "tab", "ENTER": "enter",
    "BACKSPACE": "backspace", "ESCAPE": "escape", "EQUAL": "+", "KP_ADD": "+", "MINUS": "-", "KP_SUBTRACT": "-",
}  # fmt: skip
"""Names of keys that are not named after their character, by GLFW's names."""

Tile = tuple[mujoco.MjData, Overlays]
"""State of one world, with its kinematics up to date, and its overlays."""


class SceneWindow:
    """A window that shows one model, in one or several states.

    MuJoCo's passive viewer is not used: it draws in another thread, and closing it sometimes crashes the process.
    """

    def __init__(self, model: mujoco.MjModel, max_geom: int, width: int, height: int):
        self._model = model
        self._glfw = glfw = _load_glfw()
        # One thread cannot use an EGL context, for images in memory, together with a context of another kind.
        uses_egl = os.environ.get("MUJOCO_GL", "").lower() == "egl"
        glfw.window_hint(glfw.CONTEXT_CREATION_API, glfw.EGL_CONTEXT_API if uses_egl else glfw.NATIVE_CONTEXT_API)
        glfw.window_hint(glfw.VISIBLE, True)
        glfw.window_hint(glfw.SAMPLES, model.vis.quality.offsamples)
        with warnings.catch_warnings(action="ignore"):  # the error below replaces GLFW's warning
            self._window = glfw.create_window(width, height, "crazysim", None, None)
        glfw.default_window_hints()
        require(
            self._window,
            "expected a screen that can open a window, got none. Use mode='rgb_array' without one.",
            RenderError,
        )
        glfw.make_context_current(self._window)
        glfw.swap_interval(0)  # a simulation that draws often must not wait for the screen
        self._context: Any = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        self._scene = mujoco.MjvScene(model, max_geom)
        self._option = mujoco.MjvOption()
        self._camera = mujoco.MjvCamera()
        self._settings: Any = None
        self._size = (width, height)
        self._cursor = (0.0, 0.0)
        self.on_key: Callable[[str, bool], None] | None = None
        """Function that is called with the name of a key, and True when it is pressed, False when it is released."""
        self.on_drawn: Callable[[mujoco.MjrRect, mujoco.MjrContext], None] | None = None
        """Function that draws over the finished image. It is called with the rectangle of the image, pixels, and the
        context of the window."""
        self._names = {getattr(glfw, f"KEY_{key}"): name for key, name in KEY_NAMES.items()}
        glfw.set_key_callback(self._window, self._on_key)
        glfw.set_cursor_pos_callback(self._window, self._on_move)
        glfw.set_scroll_callback(self._window, self._on_scroll)

    @property
    def is_open(self) -> bool:
        """Whether the window is open; the user or ``close`` closes it."""
        return self._window is not None

    def draw(self, data: mujoco.MjData, camera: mujoco.MjvCamera, overlays: Overlays, width: int, height: int) -> None:
        """Show one state. A new camera replaces the view set by the mouse; a new size resizes the window."""
        self.draw_tiles(1, lambda _: (data, overlays), camera, width, height)

    def draw_tiles(
        self, n: int, tile: Callable[[int], Tile], camera: mujoco.MjvCamera, width: int, height: int
    ) -> None:
        """Show several states in a grid, all from one camera.

        Args:
            tile: Function from k to the k-th tile. It is called right before the tile is drawn, so that all tiles may
                share one ``MjData``.
            camera: Camera. If it differs from the last call, it replaces the view set by the mouse.
            width: Width of the window, pixels. If the size differs from the last call, the window is resized.
            height: Height of the window, pixels.
        """
        glfw = self._glfw
        if self._window is not None and glfw.window_should_close(self._window):
            self.close()
        if self._window is None:
            return
        settings = _camera_settings(camera)
        if settings != self._settings:
            self._settings, self._camera = settings, camera
        if (width, height) != self._size:
            self._size = (width, height)
            glfw.set_window_size(self._window, width, height)
        glfw.poll_events()
        glfw.make_context_current(self._window)
        for k, rectangle in enumerate(self._tile_rectangles(n)):
            data, overlays = tile(k)
            self._update_scene(data)
            overlays.write(self._scene)
            mujoco.mjr_render(rectangle, self._scene, self._context)
            overlays.write_text(rectangle, self._context)
        if self.on_drawn is not None:
            self.on_drawn(mujoco.MjrRect(0, 0, *glfw.get_framebuffer_size(self._window)), self._context)
        glfw.swap_buffers(self._window)

    def look_at(self, point: NDArray) -> None:
        """Aim the free camera at a point, m, from its present direction and distance. (3,)"""
        self._camera.lookat[:] = point

    @property
    def cursor(self) -> tuple[float, float]:
        """Position of the cursor, from the left and from the top, 0 to 1."""
        width, height = self._glfw.get_window_size(self._window)
        return self._cursor[0] / max(width, 1), self._cursor[1] / max(height, 1)

    def is_pressed(self, button: str) -> bool:
        """Whether a button of the mouse, ``"left"`` or ``"right"``, is pressed."""
        glfw = self._glfw
        number = {"left": glfw.MOUSE_BUTTON_LEFT, "right": glfw.MOUSE_BUTTON_RIGHT}[button]
        return glfw.get_mouse_button(self._window, number) == glfw.PRESS

    def cursor_ray(self, n: int) -> tuple[int, NDArray, NDArray] | None:
        """Return the tile below the cursor, and origin, m, and direction of the ray through the cursor, world frame."""
        size = self._glfw.get_framebuffer_size(self._window)
        x, y = self.cursor[0] * size[0], (1 - self.cursor[1]) * size[1]
        for k, r in enumerate(self._tile_rectangles(n)):
            part = (x - r.left) / max(r.width, 1), (y - r.bottom) / max(r.height, 1)
            if all(0 <= u < 1 for u in part):
                return k, *camera_ray(self._scene, r.width / max(r.height, 1), *part)
        return None

    def _update_scene(self, data: mujoco.MjData) -> None:
        mujoco.mjv_updateScene(
            self._model, data, self._option, None, self._camera, mujoco.mjtCatBit.mjCAT_ALL, self._scene
        )

    def _tile_rectangles(self, n: int) -> list[mujoco.MjrRect]:
        width, height = self._glfw.get_framebuffer_size(self._window)
        columns = int(np.ceil(np.sqrt(n)))
        rows = -(-n // columns)
        w, h = width // columns, height // rows
        return [mujoco.MjrRect(k % columns * w, height - (k // columns + 1) * h, w, h) for k in range(n)]

    def close(self) -> None:
        if self._window is None:
            return
        self._glfw.make_context_current(self._window)
        self._context.free()
        self._glfw.destroy_window(self._window)
        self._window = None

    def _on_key(self, _window: Any, key: int, _code: int, action: int, _mods: int) -> None:
        name = self._names.get(key) or (chr(key).lower() if 32 < key < 127 else None)
        if self.on_key is not None and name is not None and action != self._glfw.REPEAT:
            self.on_key(name, action == self._glfw.PRESS)

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


def camera_ray(scene: mujoco.MjvScene, aspect: float, x: float, y: float) -> tuple[NDArray, NDArray]:
    """Return origin, m, and direction of the ray through a point of an image, world frame. (3,), (3,)

    Args:
        scene: Scene that was drawn.
        aspect: Width of the image divided by its height.
        x: Position in the image from the left, 0 to 1.
        y: Position from the bottom, 0 to 1.
    """
    left, right = scene.camera  # of the two eyes
    ahead, up = np.array(left.forward), np.array(left.up)
    height = left.frustum_top - left.frustum_bottom
    offset = np.cross(ahead, up) * (x - 0.5) * height * aspect + up * (left.frustum_bottom + y * height)
    return (np.array(left.pos) + np.array(right.pos)) / 2, left.frustum_near * ahead + offset


def require_screen() -> None:
    """Check that there is a screen, as far as environment variables show.

    Raises:
        RenderError: If there is none.
    """
    require(
        sys.platform != "linux" or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"),
        "expected a screen for render('human'), got neither DISPLAY nor WAYLAND_DISPLAY. Use mode='rgb_array' "
        "without a screen.",
        RenderError,
    )


def _load_glfw() -> Any:
    require_screen()
    import glfw  # comes with mujoco; images in memory do not need it

    with warnings.catch_warnings(action="ignore"):
        is_initialized = glfw.init()
    require(
        is_initialized,
        "expected a screen, got one that GLFW cannot reach. Use mode='rgb_array' without a screen.",
        RenderError,
    )
    return glfw


def _camera_settings(camera: mujoco.MjvCamera) -> tuple:
    names = ("type", "fixedcamid", "trackbodyid", "distance", "azimuth", "elevation", "orthographic")
    return (*(getattr(camera, name) for name in names), *camera.lookat)
