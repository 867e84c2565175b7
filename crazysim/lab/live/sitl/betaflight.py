"""Betaflight's software in the loop, over UDP."""

from __future__ import annotations

import os
import shlex
import struct
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from crazysim.arguments import check_flag
from crazysim.engine.backends import native
from crazysim.errors import ConfigError, expect, require, short_repr
from crazysim.lab.live.sitl.link import Datagrams, FirmwareLink, Rate, check_address
from crazysim.lab.live.sitl.measured import COS_45_DEGREES, ZURICH, Measurements, Origin, check_origin, to_frd
from crazysim.storage import as_path
from crazysim.tables import range_between, read_numbers

PORTS = (9002, 9003, 9004)
"""Ports for motor packets, which Betaflight sends, and for state and remote-control packets, which it receives."""
N_CHANNELS = 16
"""Number of channels of the remote control."""
LOCKSTEP_SOURCE = Path(__file__).with_name("lockstep.c")
"""Clock and packets of a program in lock-step."""
LOG_FILE = "betaflight.log"
"""File with what a program prints."""
START_TIMEOUT = 10.0
"""Longest time that a program takes to start, s."""
MAX_PULSE = 65535
"""Largest pulse that a packet of the remote control holds, us."""


class Betaflight(FirmwareLink):
    """A process ``betaflight_SITL``, in lock-step with the simulation or in real time.

    With ``program``, the link starts the process, unchanged, and gives it a simulated clock that stops at the time of
    the newest state packet (Linux only). Flights take as long as they take and repeat exactly, unless something talks
    to the program over TCP. Without ``program``, start the process yourself: it then adapts its clock to the clock of
    the simulation but does not wait for it. Packets follow ``src/platform/SIMULATOR`` of betaflight/betaflight (commit
    301d01ab).

    It receives the measurements of ``IMU`` and ``GPS``, and the pressure at the height that ``Barometer`` measures; a
    firmware with ``gazebo`` replaces this pressure by the pressure at the altitude of the ``GPS``. It does not
    calibrate its simulated gyroscope, so give the ``IMU`` no bias. From the true attitude it simulates a compass; built
    with ``SITL_ATTITUDE_DIRECT``, it also takes it in place of its own estimate.

    Args:
        gazebo: Whether it was built with ``ENABLE_GAZEBO_BRIDGE``, its default.
        program: Program to start in lock-step, ``obj/main/betaflight_SITL.elf`` after ``make TARGET=SITL``.
        folder: Folder in which it starts, with its settings in ``eeprom.bin``; its output goes to ``betaflight.log``.
    """

    positions = ((-1, -1), (1, -1), (-1, 1), (1, 1))
    yaw_torque_signs = (1, -1, -1, 1)
    remedy = "set yaw_motors_reversed = ON in the firmware"

    def __init__(
        self,
        host: str = "127.0.0.1",
        *,
        ports: tuple[int, int, int] = PORTS,
        gazebo: bool = True,
        origin: Origin = ZURICH,
        rc_freq: float = 50.0,
        program: str | Path | None = None,
        folder: str | Path = ".",
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
        for port in ports if program else ports[1:]:
            check_address(host, port, min_port=1)
        self._channels = np.array([1500.0, 1500.0, 1000.0, 1500.0, *[1000.0] * (N_CHANNELS - 4)])
        self._link, self.lockstep = Datagrams(host, motor_port), program is not None
        self._process: subprocess.Popen[bytes] | None = None
        if program is not None:
            try:
                self._start(as_path(program), as_path(folder), ports)
            except BaseException:
                self.close()
                raise

    def _start(self, program: Path, folder: Path, ports: tuple[int, int, int]) -> None:
        require(sys.platform == "linux", f"expected Linux for a program in lock-step, got {sys.platform}")
        require(program.is_file(), f"expected a program, got no file {program}. Build it with make TARGET=SITL.")
        require(folder.is_dir(), f"expected a folder, got no folder {folder}")
        if (compiler := native.compiler()) is None:
            raise ConfigError("expected a C++ compiler for lock-step, got none. Install g++ or set CXX.")
        with tempfile.TemporaryDirectory() as temporary, open(folder / LOG_FILE, "wb") as log:
            library = f"{temporary}/lockstep.so"
            words = [*shlex.split(compiler), *"-x c -O2 -shared -fPIC -pthread".split(), str(LOCKSTEP_SOURCE)]
            subprocess.run([*words, "-o", library, "-ldl"], check=True, capture_output=True)
            environment = os.environ | {"LD_PRELOAD": library, "CRAZYSIM_PORTS": ",".join(map(str, ports))}
            self._process = subprocess.Popen([program.resolve()], cwd=folder, env=environment, stdout=log, stderr=log)
            if self.receive(START_TIMEOUT) is None:
                raise ConfigError(
                    f"expected {program} to start, got no packet in {START_TIMEOUT:g} s. Read {folder / LOG_FILE}; a "
                    f"program without shared libraries (SITL_STATIC) has no lock-step."
                )

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
        # Its gyroscope turns about x forward, y left and z up; it negates the second rate of the packet.
        gyro, (x, y, z, w) = measured.gyro * [1, -1, 1], measured.quat
        latitude, longitude, altitude = self.origin.geodetic_position(measured.gps_pos)
        if self.gazebo:
            quat = (w, x, -y, -z)  # the Gazebo bridge conjugates with a half turn about x
            # the bridge mirrors positions about the first position
            self._start_position = self._start_position or (latitude, longitude)
            latitude, longitude = (2 * x - y for x, y in zip(self._start_position, (latitude, longitude), strict=True))
        else:
            quat = COS_45_DEGREES * np.array([w - z, x - y, x + y, w + z])  # in the axes north, west, up
            gyro = gyro * [1, 1, -1]  # without the bridge also the third
        geodetic_position = (longitude, latitude, altitude)
        state = (
            *gyro,
            *to_frd(measured.accel),
            *quat,
            *measured.gps_vel,
            *geodetic_position,
            self.origin.pressure(measured.height),
        )
        packet, rc_packet = struct.pack("<18d", measured.time, *state), b""
        if self._rc_rate.is_due(measured.time):
            rc_packet = struct.pack(f"<d{N_CHANNELS}H", measured.time, *_read_pulses(self._channels))
        if self._process is not None:
            self._link.send(packet + rc_packet, self._state_port)
            return
        self._link.send(packet, self._state_port)
        if rc_packet:
            self._link.send(rc_packet, self._rc_port)

    def receive(self, timeout: float) -> NDArray | None:
        return self._link.receive_newest(timeout, _parse_commands)

    def close(self) -> None:
        self._link.close()
        if self._process is not None:
            self._process.kill()
            self._process.wait()


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
