"""PX4's software in the loop, over MAVLink's HIL messages."""

from __future__ import annotations

import socket
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazysim.errors import ConfigError, optional_import
from crazysim.lab.live.sitl.link import MAX_DRAIN_TIME, FirmwareLink, bind_socket
from crazysim.lab.live.sitl.measured import ZURICH, Measurements, Origin, check_origin, to_frd, to_ned, to_ned_quat
from crazysim.plugins.sensors import GPS, IMU, Barometer, Magnetometer
from crazysim.plugins.sensors.sensor import Sensor
from crazysim.tables import TIMEOUT_RANGE, read_number

PORT = 4560
"""Port at which the first instance of PX4 looks for a simulation."""
UPDATED_BITS: dict[type[Sensor], int] = {IMU: 0x003F, Magnetometer: 0x01C0, Barometer: 0x1A00}
"""Bits of ``HIL_SENSOR.fields_updated`` for the fields of each sensor; PX4 ignores fields whose bits are not set. They
are ``ACCEL`` with ``GYRO``, ``MAG`` and ``BARO`` of ``SensorSource`` in SimulatorMavlink.hpp of PX4/PX4-Autopilot."""
STARTUP_LAG = 0.02
"""Time by which the simulation lags behind the clock until PX4 has started, s."""
TEMPERATURE = 25.0
"""Temperature that is reported, degrees Celsius."""
GAUSS, HECTOPASCAL = 1e-4, 100.0
"""One gauss in T, and one hectopascal in Pa."""
CHUNK_BYTES = 65536
"""Largest number of bytes that are read at once."""


class Px4(FirmwareLink):
    """Link to a process of PX4 that was started without a simulator, for example by ``make px4_sitl none_iris``.

    PX4 is the client of a TCP connection, and in lockstep with the simulation: it advances its clock when a
    ``HIL_SENSOR`` arrives, and answers with ``HIL_ACTUATOR_CONTROLS``. While it starts, it needs the clock but does not
    answer; until the first answer, the simulation runs in real time with its motors off. PX4 answers only to new
    measurements of the gyroscope; while the ``IMU`` has none, its last motor commands stay in force.

    PX4 receives each new measurement of ``IMU``, ``Barometer``, ``Magnetometer`` and ``GPS``. It treats a sensor whose
    measurements never change as broken, so give every sensor noise. ``HIL_STATE_QUATERNION`` holds the true state, for
    PX4's log; only the accelerations in it are measurements of the ``IMU``.
    """

    positions = ((1, -1), (-1, 1), (1, 1), (-1, -1))
    yaw_torque_signs = (-1, -1, 1, 1)
    remedy = "set the parameters CA_ROTOR0_KM to CA_ROTOR3_KM"
    lockstep = True

    def __init__(
        self, host: str = "127.0.0.1", *, port: int = PORT, origin: Origin = ZURICH, connect_timeout: float = 60.0
    ):
        with optional_import("links to PX4 need", "pymavlink", "mavlink", ConfigError):
            from pymavlink.dialects.v20 import common
        self._mavlink: Any = common
        self.origin = check_origin(origin)
        self.connect_timeout = read_number("connect_timeout", connect_timeout, TIMEOUT_RANGE)
        self._server = bind_socket(socket.SOCK_STREAM, host, port)
        self._server.listen(1)
        self._client: socket.socket | None = None
        self._mav: Any = common.MAVLink(None, srcSystem=1, srcComponent=1)
        self._mav.robust_parsing = True  # bytes that are not a message are skipped
        self._start_times: tuple[float, float] | None = None  # wall-clock and simulated time of the first exchange, s
        self._time = 0.0
        self._expects_answer = self._has_answered = False
        self._motors = np.zeros(4)
        self.armed = False
        """True while PX4 is armed."""

    @property
    def address(self) -> tuple[str, int]:
        """Address at which it listens."""
        return self._server.getsockname()

    def send(self, measured: Measurements) -> None:
        """Send ``HIL_SENSOR``, ``HIL_GPS`` if there is a new position, and ``HIL_STATE_QUATERNION``.

        The first call waits until PX4 connects.
        """
        origin, mav, micros = self.origin, self._mavlink, round(measured.time * 1e6)
        field = to_frd(measured.field) / GAUSS
        altitude = origin.altitude + measured.height
        pressure = origin.pressure(measured.height) / HECTOPASCAL
        updated = sum(UPDATED_BITS.get(kind, 0) for kind in measured.new)
        self._send(
            mav.MAVLink_hil_sensor_message(
                micros, *to_frd(measured.accel), *to_frd(measured.gyro), *field, pressure, 0.0, altitude, TEMPERATURE,
                updated,
            )
        )  # fmt: skip
        self._time, self._expects_answer = measured.time, IMU in measured.new
        if GPS in measured.new:
            north, east, down = (round(100 * v) for v in to_ned(measured.gps_vel))
            speed = round(float(np.hypot(north, east)))
            course = round(100 * np.degrees(np.arctan2(east, north)) % 36000)
            geodetic_position = self._geodetic_integers(measured.gps_pos)
            self._send(
                mav.MAVLink_hil_gps_message(micros, 3, *geodetic_position, 30, 40, speed, north, east, down, course, 10)
            )
        vel = [round(100 * v) for v in to_ned(measured.vel)]
        accel = [round(1e3 * v / 9.80665) for v in to_frd(measured.accel)]
        quat, ang_vel = to_ned_quat(measured.quat).tolist(), to_frd(measured.ang_vel)
        geodetic_position = self._geodetic_integers(measured.pos)
        self._send(
            mav.MAVLink_hil_state_quaternion_message(micros, quat, *ang_vel, *geodetic_position, *vel, 0, 0, *accel)
        )

    def receive(self, timeout: float) -> NDArray | None:
        now = time.monotonic()
        if self._start_times is None:
            self._start_times = now, self._time
        elapsed, simulated_elapsed = now - self._start_times[0], self._time - self._start_times[1]
        if self._has_answered:
            must_answer, wait = self._expects_answer, timeout * self._expects_answer
        else:
            must_answer, wait = elapsed > timeout, min(max(simulated_elapsed + STARTUP_LAG - elapsed, 0.0), timeout)
        motors = self._newest_commands(now + wait)
        if motors is not None:
            self._has_answered, self._motors = True, motors
        return None if motors is None and must_answer else self._motors

    def close(self) -> None:
        for connection in (self._client, self._server):
            if connection is not None:
                connection.close()

    def _newest_commands(self, deadline: float) -> NDArray | None:
        motors, now = None, time.monotonic()
        end = max(deadline, now) + MAX_DRAIN_TIME
        while now < end and self._has_data(max(deadline - now, 0.0) if motors is None else 0.0):
            for message in self._read_messages():
                if message.get_type() == "HIL_ACTUATOR_CONTROLS":
                    self.armed = bool(message.mode & self._mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
                    motors = np.clip(np.nan_to_num(message.controls[:4]), 0, 1) * self.armed  # NaN: no command
            now = time.monotonic()
        return motors

    def _geodetic_integers(self, pos: NDArray) -> tuple[int, int, int]:
        latitude, longitude, altitude = self.origin.geodetic_position(pos)
        return round(1e7 * latitude), round(1e7 * longitude), round(1e3 * altitude)

    def _wait_for_client(self) -> socket.socket:
        if self._client is None:
            self._server.settimeout(self.connect_timeout)
            try:
                self._client = self._server.accept()[0]
            except TimeoutError:
                host, port = self.address
                raise ConfigError(
                    f"expected PX4 to connect to {host}:{port} within {self.connect_timeout:g} s, got no connection. "
                    f"Start it, or set connect_timeout."
                ) from None
            self._client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return self._client

    def _send(self, message: Any) -> None:
        client = self._wait_for_client()
        client.settimeout(self.connect_timeout)
        try:
            client.sendall(message.pack(self._mav))
        except (ConnectionError, TimeoutError):
            raise _closed_error() from None

    def _has_data(self, timeout: float) -> bool:
        client = self._wait_for_client()
        client.settimeout(max(timeout, 1e-6))
        try:
            return bool(client.recv(1, socket.MSG_PEEK))
        except ConnectionError:
            raise _closed_error() from None
        except (TimeoutError, BlockingIOError):
            return False

    def _read_messages(self) -> list[Any]:
        client = self._wait_for_client()
        client.settimeout(0)
        try:
            return self._mav.parse_buffer(client.recv(CHUNK_BYTES)) or []
        except BlockingIOError:
            return []


def _closed_error() -> ConfigError:
    return ConfigError("expected PX4 to stay connected, got a closed connection. Start it again.")
