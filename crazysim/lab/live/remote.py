"""Commands from the network, in a live simulation."""

from __future__ import annotations

from crazysim.lab.live.fleet import Fleet
from crazysim.lab.live.loop import Live
from crazysim.lab.live.server import CommandQueue


class RemoteCommands:
    """Process that carries out what has arrived in a queue: ``live.add(RemoteCommands(fleet, server))``."""

    def __init__(self, fleet: Fleet, queue: CommandQueue):
        """Take a fleet of the simulation, and a ``CommandServer`` or ``StreamListener``."""
        self._fleet, self._queue = fleet, queue

    def __call__(self, live: Live) -> None:
        """Carry out the commands that have arrived since the last call, and show the lights of a show."""
        self._fleet.apply(self._queue.commands())
        live.lights[0] = self._fleet.colors()

    def reset(self, live: Live) -> None:
        """Let the drones hover where a reset, or a jump in time, has put them."""
        self._fleet.reset()
