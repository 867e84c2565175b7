"""Films, windows and pages of flown shows, and live simulations of shows, with the drones' lights."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from crazysim.arguments import check_flag
from crazysim.lab.live.leds import Leds
from crazysim.lab.live.loop import Live
from crazysim.lab.live.pace import Speed
from crazysim.lab.show_files.show import Show
from crazysim.lab.shows.flight import ShowFlight, start_simulation
from crazysim.lab.shows.show_report import collisions
from crazysim.media import Film, Flight, View, flight_of, web
from crazysim.sim.sim import Sim
from crazysim.sim.visualize import draw_label, draw_points

GLOW_RADIUS_SHARE = 0.006
"""Radius of the glow around a light, as a fraction of the size of the show."""
MIN_GLOW_RADIUS = 0.03
"""Least radius of the glow around a light, m."""
CAMERA_DISTANCE = 1.2
"""Distance of the camera, as a multiple of the size of the show."""
MARK_DURATION = 0.7
"""Time for which a collision is marked, s."""
COLLISION_COLOR = (1.0, 0.1, 0.1, 0.55)
"""Colour of the mark of a collision, rgba."""
NIGHT_LIGHT = 0.1
"""Brightest light at night, 0 to 1."""
NIGHT_SKY = (8, 10, 24)
"""Brightest colour of the sky at night, 0 to 255."""
LIGHT_FREQ = 50
"""Rate at which the LEDs change in a live simulation, Hz."""


def film(
    flight: ShowFlight, path: str | Path, fps: float = 25, progress: bool = False, night: bool = True, **view: Any
) -> int:
    """Film a flown show, and return the number of frames.

    Args:
        path: ``.mp4`` or ``.gif`` file to write.
        fps: Frames per second.
        progress: Whether to show a progress bar, which needs tqdm, where stderr is a terminal.
        night: Whether to darken the scene, which makes the lights stand out.
        view: Settings of ``crazysim.media.View`` that replace the defaults of ``create_view``.

    Raises:
        ImportError: If imageio-ffmpeg, or tqdm for a bar, is not installed.
        RenderError: If this machine cannot draw, or the file cannot be written.
    """
    if check_flag("night", night):
        darken(flight.sim)
    with Film(path, create_view(flight, **view), fps=fps, progress=progress) as recording:
        return recording.play(flight.sim, media_flight(flight))


def page(flight: ShowFlight) -> str:
    """Make an HTML page of a flown show to play in a browser, with lights.

    Raises:
        ImportError: If viser is not installed.
    """
    return web.page(media_flight(flight), lights=flight.colors)


def media_flight(flight: ShowFlight) -> Flight:
    """Return the poses of a flown show as a flight that ``crazysim.media`` can play."""
    states = SimpleNamespace(pos=flight.pos[:, None], quat=flight.quat[:, None])
    return flight_of(flight.sim, states, float(flight.times[1] - flight.times[0]))


def create_view(flight: ShowFlight, **settings: Any) -> View:
    """Return a view of the whole show with lights, time, and marks of collisions.

    Args:
        settings: Settings of ``crazysim.media.View`` that replace the defaults.
    """
    camera = camera_around(flight.planned)
    size = camera["distance"] / CAMERA_DISTANCE
    marks = collisions(flight)
    leds = Leds(flight.sim.mj_model)

    def draw(sim: Sim, world: int) -> None:
        now = float(sim.time[world, 0])
        k = int(np.argmin(np.abs(flight.times - now)))
        leds.set_colors(flight.colors[k])
        glow = np.concatenate([flight.colors[k], np.full((flight.show.n_drones, 1), 0.6)], axis=1)
        pos = np.asarray(sim.data.states.pos[world], float)
        sim.overlays.points(pos, glow, max(GLOW_RADIUS_SHARE * size, MIN_GLOW_RADIUS), emission=1.0)
        for mark in marks:
            if 0 <= now - mark["time"] <= MARK_DURATION:
                ids = [flight.show.names.index(name) for name in mark["drones"]]
                point = pos[ids].mean(0)
                draw_points(sim, point, COLLISION_COLOR, 4 * max(GLOW_RADIUS_SHARE * size, MIN_GLOW_RADIUS))
                draw_label(sim, point, _to_ascii(" x ".join(mark["drones"])))

    defaults = {"width": 1280, "height": 720, "cam_config": camera, "text": "{time:.1f} s", "draw": draw}
    return View(**(defaults | settings))


def camera_around(points: NDArray) -> dict[str, Any]:
    """Return the settings of a free camera with all points of a show in view. (n, n_drones, 3)"""
    low, high = points.min((0, 1)), points.max((0, 1))
    size = max(float(np.linalg.norm(high - low)), 1.0)
    return {"lookat": (low + high) / 2, "distance": CAMERA_DISTANCE * size, "azimuth": 110, "elevation": -18}


def darken(sim: Sim) -> None:
    """Dim the lights and the sky of a simulation's scene for a night; call it before the first image."""
    model = sim.mj_model
    head = model.vis.headlight
    for light in (model.light_diffuse, model.light_ambient, head.ambient, head.diffuse):
        np.minimum(light, NIGHT_LIGHT, out=light)
    haze = model.vis.rgba.haze
    np.minimum(haze[:3], np.array(NIGHT_SKY) / 255, out=haze[:3])
    for k in np.flatnonzero(model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX):
        n = model.tex_height[k] * model.tex_width[k] * model.tex_nchannel[k]
        sky = model.tex_data[model.tex_adr[k] : model.tex_adr[k] + n].reshape(-1, model.tex_nchannel[k])
        np.minimum(sky[:, :3], NIGHT_SKY, out=sky[:, :3], casting="unsafe")


def _to_ascii(text: str) -> str:
    return text.encode("ascii", "replace").decode()[:99]


class ShowLights:
    """Process that sets the LEDs of drones to the colours of a show: ``live.add(ShowLights(show))``."""

    def __init__(self, show: Show):
        self._lights, self._n_drones = show.lights, show.n_drones

    def compile(self, live: Live) -> None:
        """Compile the evaluation of the colours."""
        self._lights.colors([live.time])

    def __call__(self, live: Live) -> None:
        live.lights[:, : self._n_drones] = self._lights.colors([live.time])[0]


def live_show(show: Show, speed: Speed = 1.0, **settings: Any) -> Live:
    """Make a live simulation of a show; its methods ``show`` and ``run`` open a viewer and start it.

        with live_show(load_show("my_show.skyc")) as live:
            live.show(Browser())
            live.run()

    Args:
        show: Show, whose drones start hovering at the first points of their trajectories.
        speed: Simulated seconds per second, or ``"max"``.
        settings: Further settings of ``Sim``, such as ``drone`` and ``controller``.
    """
    sim = start_simulation(show, settings)
    live = Live(sim, speed=speed)
    live.add(ShowLights(show), freq=LIGHT_FREQ, name="lights")
    return live
