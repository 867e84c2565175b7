"""Light shows in a live simulation."""

from __future__ import annotations

from typing import Any

from crazysim.lab.live.loop import Live
from crazysim.lab.live.pace import Speed
from crazysim.lab.show_files.show import Show
from crazysim.lab.shows.flight import start_simulation

LIGHT_FREQ = 50
"""Rate at which the LEDs change, Hz."""


class ShowLights:
    """Process that sets the LEDs of drones to the colours of a show: ``live.add(ShowLights(show))``."""

    def __init__(self, show: Show):
        """Create the process of a show, whose k-th drone is the simulation's k-th.

        Args:
            show: Show, which begins when the simulated time is zero.
        """
        self._lights, self._n = show.lights, show.n_drones

    def __call__(self, live: Live) -> None:
        """Set the colours at the present time, equal in all worlds."""
        live.lights[:, : self._n] = self._lights.colors([live.time])[0]


def live_show(show: Show, speed: Speed = 1.0, **settings: Any) -> Live:
    """Return a live simulation of a show; ``show`` a viewer and ``run`` it.

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
