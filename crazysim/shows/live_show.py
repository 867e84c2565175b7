"""Light shows in a live simulation, with lights."""

from __future__ import annotations

from typing import Any

from crazysim.live import Live
from crazysim.shows.flight import at_start
from crazysim.trajectories.files.show import Show


class ShowLights:
    """Process that lights the drones' LEDs as a show has them: ``live.add(ShowLights(show))``."""

    def __init__(self, show: Show):
        """Take the lights of a show, whose first drone is the simulation's first."""
        self._lights, self._n = show.lights, show.n_drones

    def __call__(self, live: Live) -> None:
        """Set the colours of this moment, the same in all worlds."""
        live.lights[:, : self._n] = self._lights.colors([live.time])[0]


def live_show(show: Show, speed: float | str = 1.0, **settings: Any) -> Live:
    """Return a live simulation of a show; ``show`` a viewer and ``run`` it.

        with live_show(load_show("my_show.skyc")) as live:
            live.show(Browser())
            live.run()

    Args:
        show: Show, whose drones start hovering at the first points of their trajectories.
        speed: Simulated seconds per second, or ``"max"``.
        settings: Further settings of ``Sim``, such as ``drone`` and ``controller``.

    Raises:
        ConfigError: If a setting is invalid.
    """
    sim = at_start(show, settings)
    live = Live(sim, speed=speed)  # type: ignore[arg-type]
    live.add(ShowLights(show), name="lights")
    return live
