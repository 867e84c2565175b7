"""A live simulation in a window of the desktop, with the cameras of the scene and without further packages.

Another process draws it, because drawing in the loop, as ``sim.render`` does, would delay the control steps.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import logging
import os
import pickle
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import ArrayLike

import crazysim
from crazysim.core.settings import check_image_size
from crazysim.errors import ConfigError, RenderError, require
from crazysim.lab.live.loop import Live
from crazysim.lab.live.picture import PictureSource, list_quantities
from crazysim.lab.live.viewer import Viewer
from crazysim.media.picture import Picture
from crazysim.media.worlds import world_indices
from crazysim.scene.render import camera_id
from crazysim.scene.scene_window import require_screen

OPEN_TIMEOUT = 60.0
"""Longest time to wait for the window to open, s."""
CLOSE_TIMEOUT = 3.0
"""Longest time to wait for the window to close, s."""

log = logging.getLogger(__name__)


@dataclasses.dataclass
class Window(Viewer[Live]):
    """Viewer in a window, ``live.show(Window())``; show several windows for several views.

    The mouse turns, moves and zooms the view. A double click on a drone selects it. A double click on a vehicle, load
    or object makes viewers follow it, and a double click on the ground calls ``live.on_click``. Keys go to
    ``live.keyboard``: space pauses, a full stop makes a single step, backspace resets, tab selects the next drone, plus
    and minus change the speed, [ and ] move the chosen slider, an apostrophe chooses the next slider, R records, escape
    ends the run. A separate process draws the window. It skips pictures that it has no time for, and never delays the
    simulation.
    """

    worlds: Sequence[int] = (0,)
    """Indices of the worlds, shown in a grid."""
    width: int = 1280
    """Width, pixels."""
    height: int = 720
    """Height, pixels."""
    camera: int | str = -1
    """Name or id of a camera; -1 is the free camera, which the mouse moves."""
    cam_config: Mapping[str, ArrayLike] | None = None
    """Initial settings of the free camera: lookat, distance, azimuth, elevation."""
    follow: bool = False
    """Whether to let the free camera look at the followed body."""
    trail: float = 2.0
    """Duration of the motion that trails show, s; 0 for no trails."""
    setpoints: bool = True
    """Whether to draw the goals of the loop, or else the positions of state commands."""
    contacts: bool = False
    """Whether to mark drones that touch something; contacts are then computed for every picture."""
    wind: bool = True
    """Whether to draw the wind at every drone."""
    plot: str = ""
    """Quantity of the selected drone that is plotted over time, such as ``"states.pos"``; empty for none."""

    def __post_init__(self) -> None:
        check_image_size(self.width, self.height)
        require(np.isfinite(self.trail) and self.trail >= 0, f"expected a trail of 0 s or more, got {self.trail!r}")
        self._process: subprocess.Popen[bytes] | None = None
        self._next_picture: Picture | None = None
        self._picture_changed = threading.Condition()

    @property
    def is_open(self) -> bool:
        return self._process is not None and self._process.poll() is None

    def open(self, live: Live) -> None:
        require_screen()
        sim = live.sim
        worlds = world_indices(sim, self.worlds).tolist()
        camera_id(sim.mj_model, self.camera)
        if self.plot and self.plot not in (names := [*live.quantities, *list_quantities(sim)]):
            raise ConfigError(f"expected a quantity to plot, one of {', '.join(names)}, got {self.plot!r}")
        self._source = PictureSource(sim, worlds, self.contacts, self.wind, self.trail, self.setpoints)
        path = os.pathsep.join([str(Path(crazysim.__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
        self._process = process = subprocess.Popen(
            [sys.executable, "-m", "crazysim.lab.live.window_program"], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            env=os.environ | {"PYTHONPATH": path},
        )  # fmt: skip
        settings = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        _send_message(process, {"model": _serialize_model(sim.mj_model), "settings": settings})
        ready_event = threading.Event()
        threading.Thread(target=self._read_actions, args=(live, process, ready_event), daemon=True).start()
        if not ready_event.wait(OPEN_TIMEOUT) or not self.is_open:
            self.close()
            raise RenderError("expected a screen that can open a window, got none. Use Browser() without one.")
        threading.Thread(target=self._send_pictures, args=(process,), daemon=True).start()

    def update(self, live: Live) -> None:
        self._shown_picture = picture = self._source.take_picture(live, self.plot)
        with self._picture_changed:
            self._next_picture = picture
            self._picture_changed.notify()

    def close(self) -> None:
        process, self._process = self._process, None
        with self._picture_changed:
            self._picture_changed.notify()
        if process is None:
            return
        with contextlib.suppress(OSError):
            process.stdin.close()  # the process ends at the end of its input
        try:
            process.wait(CLOSE_TIMEOUT)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()

    def _send_pictures(self, process: subprocess.Popen[bytes]) -> None:
        while True:
            with self._picture_changed:
                self._picture_changed.wait_for(lambda: self._next_picture is not None or self._process is not process)
                picture, self._next_picture = self._next_picture, None
            if self._process is not process or picture is None:
                return
            try:
                _send_message(process, picture)
            except (OSError, ValueError):
                return  # the window was closed

    def _read_actions(self, live: Live, process: subprocess.Popen[bytes], ready_event: threading.Event) -> None:
        for line in process.stdout:
            kind, *values = json.loads(line)
            if kind == "ready":
                ready_event.set()
            elif kind == "press":
                live.keyboard.press(*values)
            elif kind == "release":
                live.keyboard.release(*values)
            elif kind == "click":
                k, origin, direction = values
                origins = np.full((len(self.worlds), 3), np.nan)
                origins[k] = origin
                live.click_along(self._source.bodies, self._shown_picture, origins, np.array(direction))
        process.stdout.close()
        process.wait()
        live.keyboard.release_all()
        ready_event.set()


def _serialize_model(model: mujoco.MjModel) -> bytes:
    buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return buffer.tobytes()


def _send_message(process: subprocess.Popen[bytes], message: object) -> None:
    process.stdin.write(pickle.dumps(message, pickle.HIGHEST_PROTOCOL))
    process.stdin.flush()
