"""Program of a window: it draws each ``Picture``, the state of a simulation, that arrives on its standard input.

It writes the user's actions to its output.
"""

from __future__ import annotations

import contextlib
import json
import os
import pickle
import sys
import threading
import time
from typing import Any, BinaryIO, TextIO

import mujoco
import numpy as np

from crazysim.errors import RenderError
from crazysim.lab.live.chart import Chart
from crazysim.lab.live.leds import Leds
from crazysim.media.picture import WIND_COLOR, WIND_RADIUS, Picture
from crazysim.media.trail import draw_paths
from crazysim.scene.overlays import Overlays
from crazysim.scene.render import camera_id
from crazysim.scene.scene_window import SceneWindow
from crazysim.scene.sync import update_poses

IDLE_TIME = 0.005
"""Time between two checks for a new picture, s."""
REDRAW_TIME = 0.03
"""Longest time between two drawings, s: the mouse moves the view even when no new picture arrives."""
DOUBLE_CLICK_TIME = 0.35
"""Longest time between the clicks of a double click, s."""
MAX_CLICK_MOVE = 0.01
"""Largest movement of the cursor between the clicks of a double click, as a fraction of the window's size."""


class Inbox:
    """The latest picture from the standard input, read by a thread."""

    def __init__(self, stream: BinaryIO):
        self._stream = stream
        self.picture: Picture | None = None
        self.has_ended = False
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        with contextlib.suppress(EOFError, pickle.UnpicklingError):
            while True:
                self.picture = pickle.load(self._stream)
        self.has_ended = True


class Program:
    """The window and its model, trails and lights."""

    def __init__(self, model: mujoco.MjModel, settings: dict[str, Any], out: TextIO):
        self._model, self._data, self._settings = model, mujoco.MjData(model), settings
        self._out = out
        self._leds = Leds(model)
        self._overlays = Overlays(limit=100_000)
        self._camera = mujoco.MjvCamera()
        fixed_camera_id = camera_id(model, settings["camera"])
        if fixed_camera_id >= 0:
            self._camera.type, self._camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, fixed_camera_id
        else:
            mujoco.mjv_defaultFreeCamera(model, self._camera)
            for key, value in (settings["cam_config"] or {}).items():
                setattr(self._camera, key, value if np.ndim(value) == 0 else np.asarray(value, float))
        self.window = SceneWindow(model, 100_000 + model.ngeom, settings["width"], settings["height"])
        self.window.on_key = lambda key, down: self._send("press" if down else "release", key)
        self._chart = Chart(settings["plot"])
        self.window.on_drawn = self._chart.draw
        self._was_down, self._last_click = False, (-np.inf, (0.0, 0.0))

    def run(self, inbox: Inbox) -> None:
        """Draw until the input ends or the user closes the window."""
        last_picture, last_draw_time = None, -np.inf
        self._send("ready")
        while self.window.is_open and not inbox.has_ended:
            picture, now = inbox.picture, time.perf_counter()
            if picture is None or (picture is last_picture and now - last_draw_time < REDRAW_TIME):
                time.sleep(IDLE_TIME)
                continue
            if picture is not last_picture:
                self._chart.add(picture)
            last_picture, last_draw_time = picture, now
            self.draw(picture)
        self.window.close()

    def draw(self, picture: Picture) -> None:
        """Draw a picture, and report a double click."""
        if self._settings["follow"] and picture.focus is not None and np.isfinite(picture.focus.pos).all():
            self.window.look_at(picture.focus.pos)
        n, settings = len(picture.worlds), self._settings
        self.window.draw_tiles(
            n, lambda k: self._compose_tile(picture, k), self._camera, settings["width"], settings["height"]
        )
        if self.window.is_open and self._is_double_click() and (ray := self.window.cursor_ray(n)) is not None:
            k, origin, direction = ray
            self._send("click", k, origin.tolist(), direction.tolist())

    def _compose_tile(self, picture: Picture, k: int) -> tuple[mujoco.MjData, Overlays]:
        data, overlays = self._data, self._overlays
        data.mocap_pos[:], data.mocap_quat[:] = picture.pos[k], np.roll(picture.quat[k], 1, axis=-1)
        update_poses(self._model, data)
        overlays.clear()
        draw_paths(overlays, picture.trail[:, k])
        for spheres in picture.spheres.values():
            is_shown = spheres.is_shown[k]
            overlays.points(spheres.pos[k, is_shown], spheres.rgba[k, is_shown], spheres.radius, spheres.emission)
        for start, end in picture.wind[k]:
            overlays.capsule(start, end, WIND_RADIUS, WIND_COLOR, cylinder=True)
        self._leds.set_colors(picture.lights[k])
        focus = picture.focus
        if focus is not None and focus.shown_index == k:
            overlays.label(_ascii(focus.name), focus.pos + [0.0, 0.0, focus.radius])
        text = picture.status if k == 0 else ""
        if len(picture.worlds) > 1:
            text = f"world {picture.worlds[k]}\n{text}".strip()
        if text:
            overlays.text(text, "top left")
        if k == 0 and picture.widget_lines:
            overlays.text(_ascii("\n".join(picture.widget_lines)), "bottom left")
        return data, overlays

    def _is_double_click(self) -> bool:
        is_down, was_down = self.window.is_pressed("left"), self._was_down
        self._was_down = is_down
        if not is_down or was_down:
            return False
        (last_time, last_cursor), cursor, now = self._last_click, self.window.cursor, time.perf_counter()
        is_double = (
            now - last_time < DOUBLE_CLICK_TIME
            and max(abs(a - b) for a, b in zip(last_cursor, cursor, strict=True)) < MAX_CLICK_MOVE
        )
        self._last_click = (-np.inf if is_double else now, cursor)
        return is_double

    def _send(self, *message: object) -> None:
        try:
            self._out.write(json.dumps(message) + "\n")
            self._out.flush()
        except OSError:  # the simulation has ended
            self.window.close()


def _ascii(text: str) -> str:
    return text.encode("ascii", "replace").decode()


def main() -> int:
    """Show a window until the input ends; return the exit status."""
    out = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # output of libraries must not reach the simulation
    stream = sys.stdin.buffer
    setup = pickle.load(stream)
    model = mujoco.MjModel.from_binary_path("scene.mjb", {"scene.mjb": setup["model"]})
    try:
        program = Program(model, setup["settings"], out)
    except RenderError as error:
        print(error, file=sys.stderr)
        return 2
    program.run(Inbox(stream))
    return 0


if __name__ == "__main__":
    sys.exit(main())
