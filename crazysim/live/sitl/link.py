"""Links to the process of a firmware: their interface, the arrangement of its motors, and UDP sockets."""

from __future__ import annotations

import contextlib
import socket
from abc import abstractmethod
from typing import ClassVar

from numpy.typing import NDArray

from crazysim.closing import Closing
from crazysim.errors import ConfigError
from crazysim.live.sitl.measured import Measured

ROUNDING = 1e-6
"""Tolerance of times for the rounding of sums of periods, s."""
LARGEST = 65535
"""Longest datagram, bytes."""


class FirmwareLink(Closing):
    """Link to the process of a firmware that flies one quadrotor.

    ``positions`` are signs of x (forward) and y (left) of motors 1 to 4, ``yaw_torque_signs`` those of the torque about
    z (up) with which each acts on the body: positive for a rotor that turns clockwise, seen from above.
    """

    positions: ClassVar[tuple[tuple[int, int], ...]]
    yaw_torque_signs: ClassVar[tuple[int, ...]]
    remedy: ClassVar[str]
    """Remedy for an airframe whose rotors turn the other way round, for a message."""
    lockstep: ClassVar[bool]
    """True for a firmware that waits for the simulation, False for one with a clock of its own."""

    @abstractmethod
    def send(self, measured: Measured) -> None:
        """Send the measurements of an instant."""

    @abstractmethod
    def receive(self, timeout: float) -> NDArray | None:
        """Return the newest motor commands from 0 to 1, or None if none arrived in time. (4,)

        Args:
            timeout: Time to wait for one, s; 0 for those that are there.
        """


class Rate:
    """Times at which something is due, at a rate in simulated time."""

    def __init__(self, freq: float):
        """Begin at once; ``freq`` is the rate, Hz."""
        self._period, self._next = 1 / freq, 0.0

    def is_due(self, time: float) -> bool:
        """Return True if it is due at a simulated time, s, and schedule the next one."""
        if time < self._next - ROUNDING:
            return False
        self._next = max(self._next + self._period, time)
        return True


class Datagrams(Closing):
    """UDP socket that sends to one address, and receives the newest packet."""

    def __init__(self, host: str, port: int):
        """Bind the socket to a port of this machine.

        Raises:
            ConfigError: If the port is in use.
        """
        self._host = host
        self._sender: tuple[str, int] | None = None
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind((host, port))
        except OSError as error:
            self._socket.close()
            raise ConfigError(f"expected a free port at {host}:{port}, got: {error}. End what uses it.") from error

    def send(self, packet: bytes, port: int) -> None:
        """Send a packet, which is lost if no program listens."""
        with contextlib.suppress(ConnectionRefusedError):
            self._socket.sendto(packet, (self._host, port))

    def answer(self, packet: bytes) -> None:
        """Send a packet to the sender of the last one."""
        if self._sender is not None:
            with contextlib.suppress(ConnectionRefusedError):
                self._socket.sendto(packet, self._sender)

    def newest(self, timeout: float, size: int) -> bytes | None:
        """Return the newest packet of at least a size, or None if none arrived in time.

        Args:
            timeout: Time to wait for one, s; 0 for those that are there.
            size: Size, bytes.
        """
        found = None
        self._socket.settimeout(timeout)
        with contextlib.suppress(TimeoutError, BlockingIOError, ConnectionRefusedError):
            while True:
                packet, sender = self._socket.recvfrom(LARGEST)
                if len(packet) >= size:
                    found, self._sender = packet, sender
                    self._socket.settimeout(0)
        return found

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()
