"""A server and a client, whose threads turn messages from the network into commands in a queue.

They share only a queue with the simulation, which removes commands from it between two steps.
"""

from __future__ import annotations

import contextlib
import logging
import queue
import socket
import socketserver
import threading
import time
from collections.abc import Callable, Iterator, Sequence

from crazysim.errors import ConfigError, address_message, require
from crazysim.lab.live.commands import Command, parse_command
from crazysim.lab.live.framing import FramingError, Message, MessageBuffer, Request, ShowFile
from crazysim.storage import Closeable
from crazysim.tables import TIMEOUT_RANGE, read_number

DRONE_PORT, STREAM_PORT = 7000, 7002
"""Ports for commands to single drones and for the stream to all drones, as in AIMotionLab's test server,
a stand-in for its Skybrush server."""
MAX_QUEUE = 10_000
"""Largest number of commands that wait for the simulation."""
MAX_PEERS = 64
"""Largest number of simultaneous connections to a port."""
MESSAGE_TIMEOUT = 10.0
"""Time in which a message that has begun must be complete, s."""
POLL_INTERVAL = 0.2
"""Interval at which a thread that waits for bytes checks if it must stop, s."""

log = logging.getLogger(__name__)


class CommandQueue(Closeable):
    """Commands that wait for the simulation."""

    def __init__(self) -> None:
        self._queue: queue.Queue[Command] = queue.Queue(MAX_QUEUE)

    def commands(self) -> list[Command]:
        """Return the commands that have arrived before this call, in order; later commands wait for the next call."""
        commands = []
        with contextlib.suppress(queue.Empty):
            for _ in range(self._queue.qsize()):
                commands.append(self._queue.get_nowait())
        return commands

    def _enqueue(self, command: Command) -> None:
        try:
            self._queue.put_nowait(command)
        except queue.Full:
            raise ConfigError(
                f"expected at most {MAX_QUEUE} waiting commands, got one more. Call commands() more often."
            ) from None


class CommandServer(CommandQueue):
    """Server for the protocol of AIMotionLab's Skybrush server, which runs in other threads.

    At ``drone_port`` a client takes control of one drone with ``REQ_07``, answered by ``ACK_07`` or, if the drone
    does not exist or another client has it, ``ACK_00``. Its commands, ``CMDSTART_takeoff_0.5_EOF`` for example, are
    answered by ``ACK``, or ``ERR`` if they are invalid. At ``stream_port`` messages name their drone,
    ``07_CMDSTART_takeoff_0.5_EOF``; shows and ``START`` are accepted too.

        with CommandServer() as server:
            while True:
                fleet.apply(server.commands())
                sim.step(10)
    """

    def __init__(
        self,
        drones: Sequence[int] = tuple(range(1, 100)),
        host: str = "127.0.0.1",
        drone_port: int = DRONE_PORT,
        stream_port: int = STREAM_PORT,
        timeout: float = MESSAGE_TIMEOUT,
    ):
        super().__init__()
        self.drones, self.timeout = frozenset(drones), read_number("timeout", timeout, TIMEOUT_RANGE)
        self._claimed_drones: set[int] = set()
        self._lock = threading.Lock()
        self._stop_event = threading.Event()
        self._listeners = []
        if host not in ("127.0.0.1", "localhost", "::1"):
            log.warning("listening at %s: every machine of that network can command the drones", host)
        for port, serve in ((drone_port, self._serve_drone), (stream_port, self._serve_stream)):
            try:
                listener = _Listener((host, port), serve)
            except (OSError, OverflowError) as error:
                self.close()
                raise ConfigError(address_message(host, port, error)) from error
            self._listeners.append(listener)
            threading.Thread(target=listener.serve_forever, args=(POLL_INTERVAL,), daemon=True).start()

    @property
    def drone_port(self) -> int:
        """Port for commands to single drones."""
        return self._listeners[0].server_address[1]

    @property
    def stream_port(self) -> int:
        """Port for the stream to all drones."""
        return self._listeners[1].server_address[1]

    def close(self) -> None:
        self._stop_event.set()
        for listener in self._listeners:
            listener.shutdown()
            listener.server_close()

    def _serve_drone(self, peer: socket.socket, peer_name: str) -> None:
        drone = None
        try:
            for message in _read_messages(peer, self._stop_event, self.timeout):
                if drone is None:
                    if not isinstance(message, Request) or not self._claim_drone(message.drone):
                        # The drone is None if the message is not a request.
                        log.warning("%s refused: drone %s is not free", peer_name, getattr(message, "drone", None))
                        peer.sendall(b"ACK_00")
                        return
                    drone = message.drone
                    peer.sendall(f"ACK_{drone:02d}".encode())
                elif isinstance(message, Message):
                    self._answer_message(peer, peer_name, message, drone)
                else:
                    raise FramingError("expected commands after the request, got another request or a show")
        finally:
            with self._lock:
                self._claimed_drones.discard(drone)  # type: ignore[arg-type]

    def _claim_drone(self, drone: int) -> bool:
        with self._lock:
            if drone not in self.drones or drone in self._claimed_drones:
                return False
            self._claimed_drones.add(drone)
            return True

    def _serve_stream(self, peer: socket.socket, peer_name: str) -> None:
        for message in _read_messages(peer, self._stop_event, self.timeout):
            if isinstance(message, Request):
                raise FramingError("expected messages with the ID of a drone, got a request")
            self._answer_message(peer, peer_name, message, None)

    def _answer_message(
        self, peer: socket.socket, peer_name: str, message: Message | ShowFile, drone: int | None
    ) -> None:
        try:
            if drone is not None and isinstance(message, Message) and message.drone not in (None, drone):
                raise ConfigError(f"expected commands to drone {drone}, got one to drone {message.drone}")
            self._enqueue(parse_command(message, drone))
        except ConfigError as error:
            log.warning("%s: command refused: %s", peer_name, error)
            peer.sendall(b"ERR")
            return
        peer.sendall(b"ACK")


class StreamListener(CommandQueue):
    """Client of a server's stream of commands, such as port 7002 of AIMotionLab's test server, in another thread.

    The simulation may be one of many receivers. Every valid command is answered by ``ACK``; others are logged. When
    the server disconnects or sends bytes that are not a message, the listener stops and ``is_connected`` becomes
    False; the fleet keeps flying.
    """

    def __init__(self, host: str = "127.0.0.1", port: int = STREAM_PORT, timeout: float = MESSAGE_TIMEOUT):
        super().__init__()
        self._stop_event = threading.Event()
        self._peer = connect(host, port, timeout)
        self._timeout = float(timeout)
        self._thread = threading.Thread(target=self._listen, args=(f"{host}:{port}",), daemon=True)
        self._thread.start()

    @property
    def is_connected(self) -> bool:
        """Whether the connection is open."""
        return self._thread.is_alive()

    def close(self) -> None:
        self._stop_event.set()
        self._thread.join(5 * POLL_INTERVAL)
        self._peer.close()

    def _listen(self, peer_name: str) -> None:
        with _log_errors(peer_name), contextlib.closing(self._peer):
            for message in _read_messages(self._peer, self._stop_event, self._timeout):
                if isinstance(message, Request):
                    raise FramingError("expected commands, got a request")
                try:
                    self._enqueue(parse_command(message))
                    self._peer.sendall(b"ACK")
                except ConfigError as error:
                    log.warning("%s: command refused: %s", peer_name, error)


def connect(host: str, port: int, timeout: float) -> socket.socket:
    read_number("timeout", timeout, TIMEOUT_RANGE)
    try:
        return socket.create_connection((host, port), timeout)
    except (OSError, OverflowError) as error:
        raise ConfigError(f"expected a server at {host}:{port}, got none: {error}. Start it first.") from error


class _Listener(socketserver.ThreadingTCPServer):
    """Listening socket with a thread for every connection."""

    allow_reuse_address, daemon_threads, block_on_close = True, True, False

    def __init__(self, address: tuple[str, int], serve: Callable[[socket.socket, str], None]):
        self._serve, self._free_connections = serve, threading.BoundedSemaphore(MAX_PEERS)
        super().__init__(address, socketserver.BaseRequestHandler)

    def finish_request(self, request: socket.socket, client_address: tuple[str, int]) -> None:
        peer_name = f"{client_address[0]}:{client_address[1]}"
        if not self._free_connections.acquire(blocking=False):
            log.warning("%s refused: %d clients are connected already", peer_name, MAX_PEERS)
            return
        try:
            with _log_errors(peer_name):
                self._serve(request, peer_name)
        finally:
            self._free_connections.release()


@contextlib.contextmanager
def _log_errors(peer_name: str) -> Iterator[None]:
    try:
        yield
        log.info("%s disconnected", peer_name)
    except (FramingError, TimeoutError) as error:
        log.warning("%s refused: %s", peer_name, error)
    except OSError as error:
        log.warning("%s lost: %s", peer_name, error)


def _read_messages(
    peer: socket.socket, stop_event: threading.Event, timeout: float
) -> Iterator[Message | Request | ShowFile]:
    buffer, deadline = MessageBuffer(), None
    peer.settimeout(POLL_INTERVAL)
    while not stop_event.is_set():
        if deadline is not None and time.monotonic() > deadline:
            raise TimeoutError(f"expected a complete message within {timeout:g} s")
        try:
            received = peer.recv(2**16)
        except TimeoutError:
            continue
        if not received:
            require(
                not buffer.has_partial_message,
                "expected a complete message, got the end of the connection",
                FramingError,
            )
            return
        for message in buffer.feed(received):
            deadline = None
            peer.settimeout(timeout)  # for the answer
            yield message
            peer.settimeout(POLL_INTERVAL)
        if not buffer.has_partial_message:
            deadline = None
        elif deadline is None:
            deadline = time.monotonic() + timeout
