"""CRTP over UDP, with one port for each drone: ``cflib`` connects to ``udp://127.0.0.1:19850`` and the ports after it.

The protocol has no passwords, so the server binds to this machine only unless another address is given.
"""

from __future__ import annotations

import contextlib
import logging
import selectors
import socket
import threading

from crazysim.errors import ConfigError, address_message
from crazysim.lab.live.crtp.device import CrtpDevice
from crazysim.lab.live.swarm import Swarm
from crazysim.storage import Closeable

PORT = 19850
"""First port; cflib scans ten ports from this one on."""
POLL_INTERVAL = 0.1
"""Longest time until the thread ends after ``close``, s."""

log = logging.getLogger(__name__)


class CrtpServer(Closeable):
    """UDP server for the drones of a swarm; a thread answers the clients."""

    def __init__(self, swarm: Swarm, host: str = "127.0.0.1", port: int = PORT):
        if host not in ("127.0.0.1", "localhost"):
            log.warning("listening at %s: every machine of that network can fly the drones", host)
        swarm.compile_step()
        self.swarm = swarm
        self.devices = [CrtpDevice(swarm, k) for k in range(len(swarm.names))]
        self._clients: list[tuple[str, int] | None] = [None] * len(self.devices)
        self._sockets: list[socket.socket] = []
        self._selector = selectors.DefaultSelector()
        self._stop_event = threading.Event()
        for k in range(len(self.devices)):
            server_socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self._sockets.append(server_socket)
            try:
                server_socket.bind((host, port + k if port else 0))
            except (OSError, OverflowError) as error:
                self._close_sockets()
                raise ConfigError(address_message(host, port + k, error)) from error
            server_socket.setblocking(False)
            self._selector.register(server_socket, selectors.EVENT_READ, k)
        swarm.listeners.append(self._send_due_packets)
        self._thread = threading.Thread(target=self._serve, name="crtp", daemon=True)
        self._thread.start()

    @property
    def uris(self) -> list[str]:
        """URIs of the drones for cflib."""
        addresses = [server_socket.getsockname() for server_socket in self._sockets]
        return [f"udp://{host if host != '0.0.0.0' else '127.0.0.1'}:{port}" for host, port in addresses]

    def close(self) -> None:
        self._stop_event.set()
        self._thread.join()
        self.swarm.listeners.remove(self._send_due_packets)
        self._close_sockets()

    def _close_sockets(self) -> None:
        for server_socket in self._sockets:
            server_socket.close()
        self._selector.close()

    def _serve(self) -> None:
        while not self._stop_event.is_set():
            for key, _ in self._selector.select(POLL_INTERVAL):
                k = key.data
                try:
                    packet, address = self._sockets[k].recvfrom(2048)
                    if packet != b"\xff":
                        self._clients[k] = address
                    for answer in self.devices[k].handle(packet):
                        self._sockets[k].sendto(answer, address)
                except OSError:  # the client is gone
                    continue
                except Exception:  # the other drones still get answers
                    log.exception("%s: a packet was not answered", self.swarm.names[k])

    def _send_due_packets(self) -> None:
        for device, server_socket, client in zip(self.devices, self._sockets, self._clients, strict=True):
            if client is not None:
                for packet in device.due_packets():
                    with contextlib.suppress(OSError):
                        server_socket.sendto(packet, client)
