"""Server and clients over real sockets: commands, answers, and peers that misbehave."""

import contextlib
import logging
import socket
import threading
import time

import numpy as np
import pytest
from tcp_clients import DroneClient, StreamClient
from waiting import wait_for

from crazysim.errors import ConfigError
from crazysim.lab.live import (
    CommandServer,
    Hover,
    Land,
    LoadShow,
    SetParameter,
    Start,
    StartShow,
    StreamListener,
    TakeOff,
    Upload,
)
from crazysim.lab.live.server import CommandQueue
from crazysim.lab.show_files import Lights, Show, save_show
from crazysim.trajectories import Trajectory, figure_eight


@pytest.fixture
def server():
    with CommandServer(drones=(1, 2, 7), drone_port=0, stream_port=0) as server:
        yield server


def wait_for_commands(source, n):
    """Return the next commands as soon as there are n."""
    commands = []
    wait_for(lambda: commands.extend(source.commands()) or len(commands) >= n)
    return commands


def exchange_bytes(port, *messages, stay=False):
    """Send bytes and return all answers until the server disconnects; with ``stay``, the client ends no stream."""
    with socket.create_connection(("127.0.0.1", port), 300.0) as peer:
        answers = b""
        with contextlib.suppress(ConnectionError):
            for message in messages:
                peer.sendall(message)
            if not stay:
                peer.shutdown(socket.SHUT_WR)
            while received := peer.recv(100):
                answers += received
        return answers


def test_every_command_of_a_drone(server):
    eight = figure_eight()
    with DroneClient(7, port=server.drone_port) as drone:
        drone.command("takeoff_0.5")
        drone.upload(eight)
        for command in ("start_absolute", "start_relative", "hover", "param_stabilizer.controller=2", "land"):
            drone.command(command)
    takeoff, upload, *others = wait_for_commands(server, 7)
    assert takeoff == TakeOff(7, 0.5)
    assert isinstance(upload, Upload)
    assert upload.drone == 7
    np.testing.assert_allclose(upload.trajectory.duration, eight.duration)
    assert others == [
        Start(7, False), Start(7, True), Hover(7), SetParameter(7, "stabilizer.controller", 2.0), Land(7),
    ]  # fmt: skip


def test_one_drone_has_one_client(server, caplog):
    with DroneClient(1, port=server.drone_port):
        with pytest.raises(ConfigError, match="ACK_01"):
            DroneClient(1, port=server.drone_port)
        DroneClient(2, port=server.drone_port).close()
    with pytest.raises(ConfigError, match="ACK_03"):
        DroneClient(3, port=server.drone_port)
    wait_for(lambda: exchange_bytes(server.drone_port, b"REQ_01") == b"ACK_01")
    assert "refused: drone 3 is not free" in caplog.text


def test_one_stream_commands_all_drones(server, tmp_path):
    eight = figure_eight()
    show = Show(("a",), Trajectory.stack([eight]), Lights.stack([Lights.constant()]))
    save_show(show, tmp_path / "show.skyc")
    with StreamClient(port=server.stream_port) as stream:
        stream.command(7, "takeoff_0.5000")
        stream.upload(0, eight, "POLY4D")
        stream.load_show(tmp_path / "show.skyc")
        stream.command(0, "show")
        stream.send(b"START")
        stream.command(0, "land")
    takeoff, upload, load, *others = wait_for_commands(server, 6)
    assert takeoff == TakeOff(7, 0.5)
    assert upload.drone is None
    assert isinstance(load, LoadShow)
    assert load.show.names == ("a",)
    assert others == [StartShow(), StartShow(), Land(None)]


def test_answers_follow_the_protocol(server):
    assert exchange_bytes(server.drone_port, b"REQ_07", b"CMDSTART_takeoff_0.5_EOFCMDSTART_land_EOF") == b"ACK_07ACKACK"
    assert exchange_bytes(server.drone_port, b"REQ_05") == b"ACK_00"
    assert exchange_bytes(server.drone_port, b"CMDSTART_land_EOF") == b"ACK_00"
    assert exchange_bytes(server.stream_port, b"07_CMDSTART_takeoff_high_EOF07_CMDSTART_land_EOF") == b"ERRACK"
    assert wait_for_commands(server, 3) == [TakeOff(7, 0.5), Land(7), Land(7)]


WRONG_MESSAGES = [
    b"07_CMDSTART_takeoff_nan_EOF", b"07_CMDSTART_takeoff_-1_EOF", b"07_CMDSTART_takeoff_1e9_EOF",
    b"07_CMDSTART_takeoff_EOF", b"07_CMDSTART_start_sideways_EOF", b"07_CMDSTART_param_x_EOF",
    b"07_CMDSTART_param_x=nan_EOF", b"07_CMDSTART_dance_EOF", b"07_CMDSTART_upload_EOF", b"07_CMDSTART_upload_{}_EOF",
    b"07_CMDSTART_land_{}_EOF", b'07_CMDSTART_upload_{"version": 1, "points": [[0, [1e300, 0, 0], []]]}_EOF',
    b"07_CMDSTART_upload_{nonsense}_EOF", b"PK\x03\x04" + b"PK\x05\x06" + bytes(18) + b"SKYC",
]  # fmt: skip


def test_invalid_commands_are_refused_and_the_connection_stays(server, caplog):
    with caplog.at_level(logging.WARNING, "crazysim.lab.live"), StreamClient(port=server.stream_port) as stream:
        for message in WRONG_MESSAGES:
            with pytest.raises(ConfigError, match="ERR"):
                stream.send(message)
        stream.command(7, "hover")
    assert wait_for_commands(server, 1) == [Hover(7)]
    assert caplog.text.count("command refused: expected") == len(WRONG_MESSAGES)


def test_a_message_that_is_not_completed_is_refused(caplog):
    with CommandServer(drone_port=0, stream_port=0, timeout=0.2) as server:
        assert exchange_bytes(server.stream_port, b"07_CMDSTART_upload_{", stay=True) == b""
    assert "complete message within" in caplog.text


def test_peers_that_misbehave_are_refused(server, caplog):
    assert exchange_bytes(server.stream_port, b"GET / HTTP/1.1\r\n\r\n") == b""
    assert exchange_bytes(server.stream_port, b"07_CMDSTART_takeoff_" + b"0" * 10_000) == b""
    assert exchange_bytes(server.drone_port, bytes(10**6)) == b""
    socket.create_connection(("127.0.0.1", server.stream_port)).close()
    with socket.create_connection(("127.0.0.1", server.stream_port)) as peer:
        peer.sendall(b"07_CMDSTART_la")
    with StreamClient(port=server.stream_port) as stream:  # other clients are still served
        stream.command(1, "land")
    assert wait_for_commands(server, 1) == [Land(1)]
    for reason in ("expected a message such as", "within 200 bytes"):
        assert reason in caplog.text, reason


def test_a_drone_has_only_its_own_commands(server):
    assert exchange_bytes(server.drone_port, b"REQ_07", b"01_CMDSTART_land_EOF") == b"ACK_07ERR"
    assert exchange_bytes(server.drone_port, b"REQ_02REQ_01") == b"ACK_02"


def test_a_server_warns_if_a_network_can_reach_it(caplog):
    with CommandServer(host="127.0.0.1", drone_port=0, stream_port=0):
        assert "every machine" not in caplog.text
    with CommandServer(host="0.0.0.0", drone_port=0, stream_port=0) as server:
        assert "every machine" in caplog.text
        with pytest.raises(ConfigError, match="free address"):
            CommandServer(host="0.0.0.0", drone_port=server.drone_port, stream_port=0)
    with pytest.raises(ConfigError, match="free address"):
        CommandServer(drone_port=70_000, stream_port=0)


def test_waiting_commands_are_bounded(monkeypatch):
    monkeypatch.setattr("crazysim.lab.live.server.MAX_QUEUE", 3)
    with CommandServer(drone_port=0, stream_port=0) as server, StreamClient(port=server.stream_port) as stream:
        for _ in range(3):
            stream.command(1, "land")
        with pytest.raises(ConfigError, match="ERR"):
            stream.command(1, "land")
        assert len(server.commands()) == 3
        stream.command(1, "land")


def test_commands_that_arrive_during_a_call_wait_for_the_next_call():
    """A producer is as fast as the consumer: it adds a command whenever one of the first nine is removed."""
    queue = CommandQueue()
    queue._enqueue(Land(1))
    take = queue._queue.get_nowait

    def take_and_refill():
        command = take()
        if command.drone < 10:
            queue._enqueue(Land(command.drone + 1))
        return command

    queue._queue.get_nowait = take_and_refill
    assert [command.drone for command in queue.commands()] == [1]
    assert [command.drone for command in queue.commands()] == [2]


def test_many_clients_at_once(server):
    def send(drone):
        with StreamClient(port=server.stream_port) as stream:
            for _ in range(20):
                stream.command(drone, "hover")

    threads = [threading.Thread(target=send, args=(drone,)) for drone in range(1, 9)]
    for thread in threads:
        thread.start()
    commands = wait_for_commands(server, 160)
    for thread in threads:
        thread.join()
    assert sorted(command.drone for command in commands) == sorted(list(range(1, 9)) * 20)


@contextlib.contextmanager
def lab_server(*messages, end_stream=False):
    """Run a server like the lab's stream server, which sends messages to its first client and collects the answers."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        answers = bytearray()

        def serve():
            peer, _ = listener.accept()
            with peer:
                for message in messages:
                    peer.sendall(message)
                    time.sleep(0.02)  # in separate packets
                if end_stream:
                    peer.shutdown(socket.SHUT_WR)
                with contextlib.suppress(OSError):
                    while received := peer.recv(100):
                        answers.extend(received)

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        yield listener.getsockname()[1], answers
        thread.join(300.0)


def test_listener_at_the_servers_stream(caplog):
    with lab_server(b"07_CMDSTART_take", b"off_0.5_EOF00_CMDST", b"ART_show_EOF") as (port, answers):
        listener = StreamListener(port=port)
        assert wait_for_commands(listener, 2) == [TakeOff(7, 0.5), StartShow()]
        assert listener.is_connected
        listener.close()
    assert bytes(answers) == b"ACKACK"


def test_listener_stops_at_garbage_and_at_the_end(caplog):
    for message, reason in ((b"garbage", "refused"), (b"07_CMDSTART_la", "end of the connection")):
        with lab_server(message, end_stream=True) as (port, _), StreamListener(port=port) as listener:
            wait_for(lambda: not listener.is_connected)
            assert listener.commands() == []
        assert reason in caplog.text
    with pytest.raises(ConfigError, match="got none"):
        StreamListener(port=port)
