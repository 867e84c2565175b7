"""Clients that command drones over TCP, through ``CommandServer`` or AIMotionLab's server."""

from __future__ import annotations

import json
from pathlib import Path

from crazysim.errors import ConfigError, require
from crazysim.lab.live.server import DRONE_PORT, STREAM_PORT, connect
from crazysim.lab.show_files.show_trajectory import format_trajectory
from crazysim.lab.trajectory_files.checks import MAX_FILE_BYTES
from crazysim.storage import Closeable, read_bytes
from crazysim.trajectories import Trajectory


class _Client(Closeable):
    """A connection that sends messages and waits for their answers."""

    def __init__(self, host: str, port: int, timeout: float):
        self._socket = connect(host, port, timeout)
        self._timeout = timeout

    def send(self, message: bytes) -> None:
        """Send a message unchanged, and wait for its ``ACK``.

        Raises:
            ConfigError: If the answer is not ``ACK``, or does not arrive in time.
        """
        try:
            self._socket.sendall(message)
        except OSError as error:
            raise ConfigError(f"expected a connection, got {error}. Connect again.") from error
        answer = self._receive(3)
        if answer != b"ACK":
            raise ConfigError(f"expected ACK, got {answer!r} after {message[:60]!r}; the server's log has the reason")

    def _receive(self, n: int) -> bytes:
        answer = b""
        try:
            while len(answer) < n:
                received = self._socket.recv(n - len(answer))
                if not received:
                    break
                answer += received
        except OSError as error:
            raise ConfigError(f"expected an answer within {self._timeout:g} s, got none: {error}") from error
        return answer

    def close(self) -> None:
        self._socket.close()


class DroneClient(_Client):
    """Control of one drone. No other client can command that drone until this client disconnects."""

    def __init__(self, drone: int, host: str = "127.0.0.1", port: int = DRONE_PORT, timeout: float = 5.0):
        require(1 <= drone <= 99, f"expected the ID of a drone from 1 to 99, got {drone!r}")
        super().__init__(host, port, timeout)
        try:
            self._socket.sendall(f"REQ_{drone:02d}".encode())
            answer = self._receive(6)
        except (OSError, ConfigError):
            self.close()
            raise
        if answer != f"ACK_{drone:02d}".encode():
            self.close()
            raise ConfigError(f"expected ACK_{drone:02d}, got {answer!r}: the drone does not exist or is taken")

    def take_off(self, height: float) -> None:
        """Take off to a height above the floor, m."""
        self.send(f"CMDSTART_takeoff_{height:.4f}_EOF".encode())

    def land(self) -> None:
        """Land below the present position."""
        self.send(b"CMDSTART_land_EOF")

    def hover(self) -> None:
        """Stay at the present setpoint."""
        self.send(b"CMDSTART_hover_EOF")

    def upload(self, trajectory: Trajectory, encoding: str = "COMPRESSED") -> None:
        """Send a trajectory of one vehicle, to be started later."""
        self.send(b"CMDSTART_upload_" + json.dumps(format_trajectory(trajectory, encoding)).encode() + b"_EOF")

    def start(self, relative: bool = False) -> None:
        """Start the trajectory that was sent last; a relative one begins at the present setpoint."""
        self.send(f"CMDSTART_start_{'relative' if relative else 'absolute'}_EOF".encode())

    def set_parameter(self, name: str, value: float) -> None:
        """Change a parameter of the drone's firmware."""
        self.send(f"CMDSTART_param_{name}={value!r}_EOF".encode())


class StreamClient(_Client):
    """Client of the server's stream port, which accepts shows and commands to any drone."""

    def __init__(self, host: str = "127.0.0.1", port: int = STREAM_PORT, timeout: float = 5.0):
        super().__init__(host, port, timeout)

    def command(self, drone: int, command: str, argument: str = "") -> None:
        """Send a command such as ``takeoff`` with its argument to the drone with an ID, or to all drones for 0."""
        self.send(f"{drone:02d}_CMDSTART_{command}_{argument}{'_' if argument else ''}EOF".encode())

    def upload(self, drone: int, trajectory: Trajectory, encoding: str = "COMPRESSED") -> None:
        """Send a trajectory of one vehicle to the drone with an ID, or to all drones for 0, to be started later."""
        text = json.dumps(format_trajectory(trajectory, encoding))
        self.send(f"{drone:02d}_CMDSTART_upload_{text}_EOF".encode())

    def load_show(self, path: str | Path) -> None:
        """Send the show of a ``.skyc`` file."""
        self.send(read_bytes(path, MAX_FILE_BYTES) + b"SKYC")

    def start_show(self) -> None:
        """Start the trajectories of all drones that have received one."""
        self.send(b"00_CMDSTART_show_EOF")
