"""Links to the process of a firmware: their interface, the arrangement of its motors, and UDP sockets."""

from __future__ import annotations

import contextlib
import socket
import time
from abc import abstractmethod
from collections.abc import Callable
from typing import ClassVar

from numpy.typing import NDArray

from crazysim.errors import ConfigError, expect
from crazysim.lab.live.sitl.measured import Measurements
from crazysim.storage import Closeable
from crazysim.tables import POSITIVE, range_between, read_number, read_numbers

ROUNDING_TOLERANCE = 1e-6
"""Tolerance for rounding errors in sums of periods, s."""
MAX_DATAGRAM = 65535
"""Longest datagram, bytes."""
MAX_PORT = 65535
"""Largest number of a port."""
MAX_DRAIN_TIME = 0.1
"""Longest time for reading the waiting packets after the timeout, s, even if more keep arriving."""


class FirmwareLink(Closeable):
    """Link to the process of a firmware that flies one quadrotor.

    ``positions`` are the signs of x (forward) and y (left) of motors 1 to 4. ``yaw_torque_signs`` are the signs of the
    torques about z (up) that their rotors exert on the body: positive for a rotor that turns clockwise seen from above.
    """

    positions: ClassVar[tuple[tuple[int, int], ...]]
    yaw_torque_signs: ClassVar[tuple[int, ...]]
    remedy: ClassVar[str]
    """Remedy for an airframe whose rotors turn in the opposite senses, for an error message."""
    lockstep: bool
    """True if the firmware waits for the simulation, False if it follows another clock."""

    @abstractmethod
    def send(self, measured: Measurements) -> None:
        """Send the measurements of one exchange."""

    @abstractmethod
    def receive(self, timeout: float) -> NDArray | None:
        """Return the newest motor commands from 0 to 1, or None if none arrived in time. (4,)

        Args:
            timeout: Time to wait for commands, s; 0 to read only what has arrived.
        """


class Rate:
    """Schedule of an action at a rate in simulated time."""

    def __init__(self, name: str, freq: float):
        self._period, self._next_time = 1 / read_number(name, freq, POSITIVE), 0.0

    def is_due(self, time: float) -> bool:
        """Whether the action is due at a simulated time, s; if so, the next action is scheduled."""
        if time < self._next_time - ROUNDING_TOLERANCE:
            return False
        self._next_time = max(self._next_time + self._period, time)
        return True


def check_address(host: str, port: int, min_port: int = 0) -> None:
    """Check an address.

    Args:
        host: Name or address of a host.
        min_port: Smallest valid port; 0 also allows port 0, which means any free port.
    """
    expect(isinstance(host, str), "host as text", host, "Use '127.0.0.1'.")
    read_numbers("port", port, range_between(min_port, MAX_PORT), ((),), whole=True)


def bind_socket(kind: socket.SocketKind, host: str, port: int) -> socket.socket:
    """Return a socket that is bound to a port of this machine."""
    check_address(host, port)
    bound_socket = socket.socket(socket.AF_INET, kind)
    if kind == socket.SOCK_STREAM:
        bound_socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        bound_socket.bind((host, port))
    except OSError as error:
        bound_socket.close()
        raise ConfigError(f"expected a free port at {host}:{port}, got: {error}. End what uses it.") from error
    return bound_socket


class Datagrams(Closeable):
    """UDP socket that sends to one address, and receives the newest packet."""

    def __init__(self, host: str, port: int):
        self._socket = bind_socket(socket.SOCK_DGRAM, host, port)
        self._host = host
        self._sender: tuple[str, int] | None = None

    def send(self, packet: bytes, port: int) -> None:
        """Send a packet, which is lost if no program listens."""
        with contextlib.suppress(ConnectionRefusedError):
            self._socket.sendto(packet, (self._host, port))

    def answer(self, packet: bytes) -> None:
        """Send a packet to the sender of the last valid packet."""
        if self._sender is not None:
            with contextlib.suppress(ConnectionRefusedError):
                self._socket.sendto(packet, self._sender)

    def receive_newest(self, timeout: float, parse: Callable[[bytes], NDArray | None]) -> NDArray | None:
        """Return the contents of the newest valid packet, or None if none arrived in time.

        Args:
            timeout: Time to wait for a packet, s; 0 to read only what has arrived.
            parse: Function that returns the contents of a packet, or None for another format, which is skipped.
        """
        newest_contents, now = None, time.monotonic()
        deadline, end = now + timeout, now + timeout + MAX_DRAIN_TIME
        while now < end:
            self._socket.settimeout(max(deadline - now, 0.0) if newest_contents is None else 0.0)
            try:
                packet, sender = self._socket.recvfrom(MAX_DATAGRAM)
            except (TimeoutError, BlockingIOError):
                break
            except ConnectionRefusedError:  # an earlier packet went to a program that does not listen
                packet, sender = b"", self._sender
            contents, now = parse(packet), time.monotonic()
            if contents is not None:
                newest_contents, self._sender = contents, sender
        return newest_contents

    def close(self) -> None:
        self._socket.close()
