"""A live simulation in the browser: the scene of recorded flights, and a panel to command it."""

from __future__ import annotations

import contextlib
import io
import logging
import threading
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from crazysim.errors import require
from crazysim.lab.live.browser_panel import BrowserPanel
from crazysim.lab.live.loop import Live
from crazysim.lab.live.picture import PictureSource
from crazysim.lab.live.viewer import Viewer
from crazysim.media.access import LOOPBACK_ADDRESSES, Access, start_guarded_server
from crazysim.media.browser_scene import BrowserScene
from crazysim.media.web import FOV, import_viser, require_free_port
from crazysim.media.worlds import world_indices

MAX_WORLDS = 64
"""Largest number of worlds that are shown if ``worlds`` is None."""
WORLD_MARGIN = 1.0
"""Free space between neighbouring worlds, m."""
CLOSE_TIMEOUT = 0.5
"""Longest time for which ``close`` waits, s."""

log = logging.getLogger(__name__)


class Browser(Viewer[Live]):
    """Viewer in any number of web browsers, served by viser in other threads.

        browser = live.show(Browser(port=8080))
        print(browser.url)

    For machines without a screen, several spectators, and plots. A click on a drone selects it; a click on a vehicle,
    load or object makes the viewer follow it. The panel plots any array of the data, pauses, resets, records, and has
    the buttons and sliders of the loop. Browsers may connect and
    disconnect at any time.

    The address has a new token every time. Whoever has the token can watch and command the simulation. Requests without
    the token and requests from pages of other sites are refused.
    """

    def __init__(
        self,
        port: int = 8080,
        host: str = "127.0.0.1",
        worlds: Sequence[int] | None = None,
        spacing: float | None = None,
        trail: float = 2.0,
        contacts: bool = False,
        wind: bool = True,
        follow: bool = False,
        plot: str = "states.pos",
    ):
        for name, value in (("trail", trail), ("spacing", 1.0 if spacing is None else spacing)):
            require(np.isfinite(value) and value >= 0, f"expected a {name} of 0 or more, got {value!r}")
        self._access = Access(host, port)
        self._worlds, self._spacing = worlds, spacing
        self._trail, self._contacts, self._wind = float(trail), contacts, wind
        self._follow, self._plot = follow, plot
        self._server: Any = None

    @property
    def url(self) -> str:
        """Address for a browser, with the token."""
        return self._access.url

    @property
    def is_open(self) -> bool:
        return self._server is not None

    @property
    def n_clients(self) -> int:
        """Number of browsers that are connected."""
        return 0 if self._server is None else len(self._server.get_clients())

    def open(self, live: Live) -> None:
        viser, sim = import_viser(), live.sim
        worlds = world_indices(sim, range(min(sim.n_worlds, MAX_WORLDS)) if self._worlds is None else self._worlds)
        access = self._access
        access.port = require_free_port(access.host, access.port)
        if access.host not in LOOPBACK_ADDRESSES:
            log.warning("listening at %s:%d: every machine of that network that has the address with its token can "
                        "watch and command the simulation", access.host, access.port)  # fmt: skip
        self._source = source = PictureSource(sim, worlds.tolist(), self._contacts, self._wind, self._trail)
        self._picture = source.take_picture(live)
        with contextlib.redirect_stdout(io.StringIO()):  # viser prints a banner
            self._server = start_guarded_server(viser, access, label="crazysim")
        scene = self._server.scene
        scene.set_up_direction("+z")
        drone_pos = np.asarray(sim.data.states.pos, float)[worlds]
        extent = float(np.nanmax(np.ptp(drone_pos, axis=1)[..., :2])) + 2 * WORLD_MARGIN
        spacing = extent if self._spacing is None else self._spacing
        self._scene = BrowserScene(self._server, source.shapes, self._picture, spacing)
        camera = self._server.initial_camera
        size = max(np.ptp(self._scene.offsets[:, :2], axis=0).max() + extent, 2.0)
        camera.fov, camera.look_at = np.deg2rad(FOV), (0.0, 0.0, 0.5)
        camera.position = (0.0, -0.9 * size, 0.6 * size + 0.5)
        self._panel = BrowserPanel(self._server, live, self._follow, self._plot)

        @self._server.on_client_connect
        def _(client: Any) -> None:
            log.info("browser %d connected at %.2f s", client.client_id, live.time)

        @self._server.on_client_disconnect
        def _(client: Any) -> None:
            if self.is_open:
                log.warning("browser %d disconnected at %.2f s", client.client_id, live.time)

        @scene.on_click()
        def _(event: Any) -> None:
            origins = event.ray_origin - self._scene.origin - self._scene.offsets
            live.click_along(source.bodies, self._picture, origins, np.asarray(event.ray_direction, float))

    def update(self, live: Live) -> None:
        if not self._server.get_clients():
            return
        self._picture = picture = self._source.take_picture(live, self._panel.plot)
        with self._server.atomic():
            self._scene.update(picture, self._panel.follow)
        self._panel.update(picture, time.perf_counter())

    def close(self) -> None:
        if self._server is not None:
            server, self._server = self._server, None
            with contextlib.redirect_stdout(io.StringIO()):  # viser prints that it stops
                # viser waits for 6 s for connections that a browser has opened in advance and not used.
                stop_thread = threading.Thread(target=server.stop, daemon=True)
                stop_thread.start()
                stop_thread.join(CLOSE_TIMEOUT)
