"""``sim://`` for cflib: a link to a swarm in this process."""

from __future__ import annotations

import queue
from typing import Any
from urllib.parse import urlparse

from crazysim.errors import ConfigError, optional_import
from crazysim.lab.live.crtp.device import CrtpDevice
from crazysim.lab.live.swarm import Swarm

_driver_classes: dict[int, type] = {}


def add_cflib_driver(swarm: Swarm) -> list[str]:
    """Make the drones of a swarm in this process available to ``cflib``; return their URIs, such as ``sim://cf1``.

    It may be called before or after ``cflib.crtp.init_drivers()``. If two swarms have drones of the same name, the
    swarm that was added last takes precedence.
    """
    with optional_import("links of cflib need", "cflib", "radio", ConfigError):
        import cflib.crtp
    remove_cflib_driver(swarm)
    _driver_classes[id(swarm)] = _create_driver(swarm)
    cflib.crtp.CLASSES.insert(0, _driver_classes[id(swarm)])
    return [f"sim://{name}" for name in swarm.names]


def remove_cflib_driver(swarm: Swarm) -> None:
    """Remove a swarm from ``cflib``."""
    import cflib.crtp

    driver = _driver_classes.pop(id(swarm), None)
    if driver in cflib.crtp.CLASSES:
        cflib.crtp.CLASSES.remove(driver)


def _create_driver(swarm: Swarm) -> type:
    from cflib.crtp.crtpdriver import CRTPDriver
    from cflib.crtp.crtpstack import CRTPPacket
    from cflib.crtp.exceptions import WrongUriType

    class SimDriver(CRTPDriver):
        """Link to one drone of a swarm."""

        def __init__(self) -> None:
            super().__init__()
            self.needs_resending = False
            self._device: CrtpDevice | None = None
            self._queue: queue.Queue[CRTPPacket] = queue.Queue()

        def connect(self, uri: str, *callbacks: Any) -> None:
            parts = urlparse(uri)
            if parts.scheme != "sim" or parts.netloc not in swarm.names:
                raise WrongUriType(f"expected one of {[f'sim://{name}' for name in swarm.names]}, got {uri!r}")
            self._device = CrtpDevice(swarm, parts.netloc)
            swarm.listeners.append(self._enqueue_due_packets)

        def send_packet(self, pk: CRTPPacket) -> None:
            if self._device is not None:
                for answer in self._device.handle(bytes([pk.header, *pk.data])):
                    self._enqueue(answer)

        def receive_packet(self, wait: float = 0) -> CRTPPacket | None:
            try:
                return self._queue.get(wait != 0, None if wait < 0 else wait)
            except queue.Empty:
                return None

        def get_status(self) -> str:
            return "simulated"

        def get_name(self) -> str:
            return "sim"

        def scan_interface(self, address: Any = None) -> list[list[str]]:
            return [[f"sim://{name}", ""] for name in swarm.names]

        def close(self) -> None:
            if self._device is not None:
                self._device = None
                swarm.listeners.remove(self._enqueue_due_packets)

        def _enqueue_due_packets(self) -> None:
            device = self._device
            if device is not None:
                for packet in device.due_packets():
                    self._enqueue(packet)

        def _enqueue(self, packet: bytes) -> None:
            self._queue.put(CRTPPacket(packet[0], packet[1:]))

    return SimDriver
