"""Betaflight's software in the loop, over UDP."""

from __future__ import annotations

import struct

import numpy as np
from numpy.typing import ArrayLike, NDArray

from crazysim.arguments import check_flag
from crazysim.errors import ConfigError, expect, short_repr
from crazysim.lab.live.sitl.link import Datagrams, FirmwareLink, Rate, check_address
from crazysim.lab.live.sitl.measured import COS_45_DEGREES, ZURICH, Measurements, Origin, check_origin, to_frd
from crazysim.tables import range_between, read_numbers

PORTS = (9002, 9003, 9004)
"""Ports for motor packets, which Betaflight sends, and for state and remote-control packets, which it receives."""
N_CHANNELS = 16
"""Number of channels of the remote control."""
MAX_PULSE = 65535
"""Largest pulse that a packet of the remote control holds, us."""


class Betaflight(FirmwareLink):
    """A process ``betaflight_SITL``, which runs in real time.

    Packets follow ``src/platform/SIMULATOR`` of betaflight/betaflight (commit 301d01ab). The firmware adapts its clock
    to the clock of the simulation but does not wait for the simulation. It answers each state packet with at most one
    motor packet.

    It receives the measurements of ``IMU`` and ``GPS``, and the pressure at the height that ``Barometer`` measures; a
    firmware with ``gazebo`` replaces this pressure by the pressure at the altitude of the ``GPS``. It also receives the
    true attitude. It simulates a compass from this attitude, and uses it in place of its own estimate unless it was
    built with ``USE_IMU_CALC``.
    """

    positions = ((-1, -1), (1, -1), (-1, 1), (1, 1))
    yaw_torque_signs = (1, -1, -1, 1)
    remedy = "set yaw_motors_reversed = ON in the firmware"
    lockstep = False

    def __init__(
        self,
        host: str = "127.0.0.1",
        *,
        ports: tuple[int, int, int] = PORTS,
        gazebo: bool = True,
        origin: Origin = ZURICH,
        rc_freq: float = 50.0,
    ):
        self.gazebo, self.origin, self._rc_rate = (
            check_flag("gazebo", gazebo),
            check_origin(origin),
            Rate("rc_freq", rc_freq),
        )
        self._start_position: tuple[float, float] | None = None
        expect(
            isinstance(ports, (tuple, list)) and len(ports) == len(PORTS),
            "ports of the motors, the state and the remote control",
            ports,
            f"Use {PORTS}.",
        )
        motor_port, self._state_port, self._rc_port = ports
        for port in (self._state_port, self._rc_port):
            check_address(host, port, min_port=1)
        self._channels = np.array([1500.0, 1500.0, 1000.0, 1500.0, *[1000.0] * (N_CHANNELS - 4)])
        self._link = Datagrams(host, motor_port)

    @property
    def channels(self) -> NDArray[np.float64]:
        """Remote control, us: roll, pitch, throttle, yaw, and the switches, 1,000 to 2,000. (16,)

        Assign all channels, or single elements; elements are checked when they are sent.
        """
        return self._channels

    @channels.setter
    def channels(self, values: ArrayLike) -> None:
        self._channels = _read_pulses(values).astype(np.float64)

    def send(self, measured: Measurements) -> None:
        gyro, (x, y, z, w) = to_frd(measured.gyro), measured.quat
        latitude, longitude, altitude = self.origin.geodetic_position(measured.gps_pos)
        if self.gazebo:
            quat = (w, x, -y, -z)  # the Gazebo bridge conjugates with a half turn about x
            # the bridge mirrors positions about the first position
            self._start_position = self._start_position or (latitude, longitude)
            latitude, longitude = (2 * x - y for x, y in zip(self._start_position, (latitude, longitude), strict=True))
        else:
            quat = COS_45_DEGREES * np.array([w - z, x - y, x + y, w + z])  # in the axes north, west, up
            gyro = gyro * [1, 1, -1]
        geodetic_position = (longitude, latitude, altitude)
        state = (
            *gyro,
            *to_frd(measured.accel),
            *quat,
            *measured.gps_vel,
            *geodetic_position,
            self.origin.pressure(measured.height),
        )
        self._link.send(struct.pack("<18d", measured.time, *state), self._state_port)
        if self._rc_rate.is_due(measured.time):
            self._link.send(
                struct.pack(f"<d{N_CHANNELS}H", measured.time, *_read_pulses(self._channels)), self._rc_port
            )

    def receive(self, timeout: float) -> NDArray | None:
        return self._link.receive_newest(timeout, _parse_commands)

    def close(self) -> None:
        self._link.close()


def _read_pulses(channels: ArrayLike) -> NDArray[np.int64]:
    pulses = read_numbers("channels", channels, range_between(0, MAX_PULSE), ((N_CHANNELS,),))
    if np.any(pulses % 1):
        raise ConfigError(f"expected channels as whole numbers, us, got {short_repr(pulses.tolist())}. Round them.")
    return pulses.astype(np.int64)


def _parse_commands(packet: bytes) -> NDArray | None:
    if len(packet) != struct.calcsize("<4f"):
        return None
    commands = np.frombuffer(packet, "<f4")
    return np.clip(commands, 0, 1) if np.isfinite(commands).all() else None
