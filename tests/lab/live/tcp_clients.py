"""Clients that command drones over TCP, as those of AIMotionLab's Skybrush server do."""

import json

from crazysim.errors import ConfigError
from crazysim.lab.live.server import connect
from crazysim.lab.show_files.show_trajectory import format_trajectory
from crazysim.storage import Closeable


class Client(Closeable):
    def __init__(self, port):
        self._socket = connect("127.0.0.1", port, 5.0)

    def send(self, message, expected=b"ACK"):
        self._socket.sendall(message)
        answer = b""
        while len(answer) < len(expected) and (received := self._socket.recv(len(expected) - len(answer))):
            answer += received
        if answer != expected:
            raise ConfigError(f"expected {expected!r}, got {answer!r}")

    def close(self):
        self._socket.close()


class DroneClient(Client):
    """Control of one drone. No other client can command that drone until this client disconnects."""

    def __init__(self, drone, port):
        super().__init__(port)
        try:
            self.send(f"REQ_{drone:02d}".encode(), f"ACK_{drone:02d}".encode())
        except ConfigError:
            self.close()
            raise

    def command(self, text):
        self.send(f"CMDSTART_{text}_EOF".encode())

    def upload(self, trajectory, encoding="COMPRESSED"):
        self.command(f"upload_{json.dumps(format_trajectory(trajectory, encoding))}")


class StreamClient(Client):
    """Client of the server's stream port, which accepts shows and commands to any drone."""

    def command(self, drone, text):
        self.send(f"{drone:02d}_CMDSTART_{text}_EOF".encode())

    def upload(self, drone, trajectory, encoding="COMPRESSED"):
        self.command(drone, f"upload_{json.dumps(format_trajectory(trajectory, encoding))}")

    def load_show(self, path):
        self.send(path.read_bytes() + b"SKYC")
