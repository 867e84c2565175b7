"""Program of a window: it draws each ``Picture``, the state of a simulation, that arrives on its standard input.

It writes the user's actions to its output.
"""

from __future__ import annotations

import json
import os
import pickle
import sys
import threading
import time
from typing import Any, BinaryIO, TextIO

import mujoco
import numpy as np

from crazysim.drones.body import LED_MATERIALS
from crazysim.errors import RenderError
from crazysim.lab.live.chart import Chart
from crazysim.lab.live.picture import LIGHT_RADIUS, WIND_SCALE, Picture
from crazysim.lab.live.scene_bodies import MARK_RADIUS, SceneBodies
from crazysim.lab.live.window import LENGTH_PREFIX
from crazysim.media.trail import Trail, choose_drone_colors
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
SETPOINT_RADIUS = 0.02
"""Radius of a setpoint's sphere, m."""
CONTACT_COLOR, FOLLOWED_COLOR, WIND_COLOR = (0.9, 0.15, 0.1, 0.4), (0.25, 0.6, 1.0, 0.25), (0.35, 0.6, 0.8, 0.9)
"""Colours of marks, rgba."""


class Inbox:
    """The latest picture from the standard input, read by a thread."""

    def __init__(self, stream: BinaryIO):
        self._stream = stream
        self.picture: Picture | None = None
        self.has_ended = False
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        while (message := read_message(self._stream)) is not None:
            self.picture = message
        self.has_ended = True


def read_message(stream: BinaryIO) -> Any:
    """Return the next message of a stream; None at its end."""
    head = stream.read(LENGTH_PREFIX.size)
    if len(head) < LENGTH_PREFIX.size:
        return None
    (length,) = LENGTH_PREFIX.unpack(head)
    content = stream.read(length)
    return pickle.loads(content) if len(content) == length else None


class Leds:
    """Materials of the drones' LEDs in a model."""

    def __init__(self, model: mujoco.MjModel):
        self._model = model
        names = [model.material(k).name.partition(":") for k in range(model.nmat)]
        leds = [
            (k, int(drone)) for k, (kind, _, drone) in enumerate(names) if kind in LED_MATERIALS and drone.isdigit()
        ]
        self._materials, self._drones = np.array(leds, int).reshape(-1, 2).T
        self._unlit_colors = model.mat_rgba[self._materials].copy(), model.mat_emission[self._materials].copy()

    def set_colors(self, colors: np.ndarray) -> None:
        """Set the colours of the drones of one world, 0 to 1; zero for off. (n_drones, 3)"""
        drone_colors = colors[self._drones]
        brightest = drone_colors.max(-1, initial=0.0)
        is_lit, (rgba, emission) = brightest > 0, self._unlit_colors
        self._model.mat_rgba[self._materials] = np.where(is_lit[:, None], np.insert(drone_colors, 3, 1.0, axis=1), rgba)
        self._model.mat_emission[self._materials] = np.where(is_lit, brightest, emission)


class Program:
    """The window and its model, trails and lights."""

    def __init__(self, model: mujoco.MjModel, bodies: SceneBodies, settings: dict[str, Any], out: TextIO):
        self._model, self._data, self._bodies, self._settings = model, mujoco.MjData(model), bodies, settings
        self._out = out
        self._trail_mocap_ids, self._leds = bodies.trail_mocap_ids, Leds(model)
        self._trail = Trail(settings["trail"]) if settings["trail"] > 0 else None
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
            if picture is not last_picture and self._trail is not None:
                self._trail.add(np.full(len(picture.worlds), picture.time), picture.pos[:, self._trail_mocap_ids])
            if picture is not last_picture:
                self._chart.add(picture)
            last_picture, last_draw_time = picture, now
            self.draw(picture)
        self.window.close()

    def draw(self, picture: Picture) -> None:
        """Draw a picture, and report a double click."""
        if self._settings["follow"] and picture.followed is not None and picture.followed[0] in picture.worlds:
            k = picture.worlds.tolist().index(picture.followed[0])
            point = picture.pos[k, picture.followed[1]]
            if np.isfinite(point).all():
                self.window.look_at(point)
        n, settings = len(picture.worlds), self._settings
        self.window.draw_tiles(
            n, lambda k: self._compose_tile(picture, k), self._camera, settings["width"], settings["height"]
        )
        if self.window.is_open and self._is_double_click():
            self._report_click(picture, self.window.pick(n, lambda k: self._compose_tile(picture, k)))

    def _compose_tile(self, picture: Picture, k: int) -> tuple[mujoco.MjData, Overlays]:
        data, overlays, settings = self._data, self._overlays, self._settings
        data.mocap_pos[:], data.mocap_quat[:] = picture.pos[k], np.roll(picture.quat[k], 1, axis=-1)
        update_poses(self._model, data)
        overlays.clear()
        drones = picture.drone_pos[k]
        colors = choose_drone_colors(len(drones), None)
        if self._trail is not None:
            self._trail.draw(overlays, k)
        if settings["setpoints"] and len(picture.setpoint[k]):
            overlays.points(picture.setpoint[k], colors, SETPOINT_RADIUS)
        if picture.has_contact[k].any():
            overlays.points(drones[picture.has_contact[k]], CONTACT_COLOR, MARK_RADIUS)
        for pos, wind in zip(drones, picture.wind[k], strict=False):
            if wind.any():
                overlays.capsule(pos, pos + WIND_SCALE * wind, 0.006, WIND_COLOR, cylinder=True)
        self._leds.set_colors(picture.lights[k])
        is_lit = picture.lights[k].any(-1)
        if is_lit.any():
            overlays.points(
                drones[is_lit], np.insert(picture.lights[k, is_lit], 3, 0.6, axis=1), LIGHT_RADIUS, emission=1.0
            )
        if picture.followed is not None and picture.followed[0] == picture.worlds[k]:
            followed_pos, radius = picture.pos[k, picture.followed[1]], self._bodies.mark_radius(picture.followed[1])
            overlays.points(followed_pos[None], FOLLOWED_COLOR, radius)
            overlays.label(_ascii(picture.followed_name), followed_pos + [0.0, 0.0, radius])
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

    def _report_click(self, picture: Picture, hit: tuple[int, int, np.ndarray] | None) -> None:
        if hit is None:
            return
        k, geom, point = hit
        root, world = self._model.body_rootid[self._model.geom_bodyid[geom]], int(picture.worlds[k])
        mocap = int(self._model.body_mocapid[root])
        if mocap >= 0:
            followed = self._bodies.items[self._bodies.owner[mocap]]
            self._send("follow", world, followed.kind, followed.index)
        else:
            self._send("click", world, point.tolist())

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
    setup = read_message(stream)
    if setup is None:
        return 1
    model = mujoco.MjModel.from_binary_path("scene.mjb", {"scene.mjb": setup["model"]})
    try:
        program = Program(model, setup["bodies"], setup["settings"], out)
    except RenderError as error:
        print(error, file=sys.stderr)
        return 2
    program.run(Inbox(stream))
    return 0


if __name__ == "__main__":
    sys.exit(main())
