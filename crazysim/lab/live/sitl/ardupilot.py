"""ArduPilot's software in the loop, over its JSON interface."""

from __future__ import annotations

import json
import struct

import numpy as np
from numpy.typing import NDArray

from crazysim.lab.live.sitl.link import Datagrams, FirmwareLink
from crazysim.lab.live.sitl.measured import Measurements, to_frd, to_ned, to_ned_quat

PORT = 9002
"""Port at which a simulation listens."""
PACKET_LAYOUTS = {18458: "<HHI16H", 29569: "<HHI32H"}
"""Layouts of packets with 16 and 32 outputs, by the first number in a packet. The frame rate, the frame count and the
pulse widths, us, follow that number."""
PULSE_MIN, PULSE_MAX = 1000.0, 2000.0
"""Pulse widths for a motor that is off, and for a motor at full power, us: ``MOT_PWM_MIN`` and ``MOT_PWM_MAX``."""


class ArduPilot(FirmwareLink):
    """A process of ArduPilot that was started with ``--model JSON:ADDRESS``; it waits for each answer.

    The interface follows ``libraries/SITL/examples/JSON`` of ArduPilot/ardupilot. ArduPilot no longer supports the HIL
    messages of MAVLink.

    It receives the measurements of the ``IMU``. The interface has no fields for other sensors: ArduPilot
    simulates satellite navigation, barometer and compass itself, with the errors of its parameters ``SIM_*``, from
    the true position, velocity and attitude.
    """

    positions = ((1, -1), (-1, 1), (1, 1), (-1, -1))
    yaw_torque_signs = (-1, -1, 1, 1)
    remedy = "set FRAME_TYPE to a frame whose motors turn in these senses"
    lockstep = True

    def __init__(self, host: str = "127.0.0.1", *, port: int = PORT):
        self._link = Datagrams(host, port)

    def send(self, measured: Measurements) -> None:
        message = {
            "timestamp": measured.time,
            "imu": {"gyro": to_frd(measured.gyro).tolist(), "accel_body": to_frd(measured.accel).tolist()},
            "position": to_ned(measured.pos).tolist(),
            "quaternion": to_ned_quat(measured.quat).tolist(),
            "velocity": to_ned(measured.vel).tolist(),
        }
        self._link.answer(f"\n{json.dumps(message)}\n".encode())

    def receive(self, timeout: float) -> NDArray | None:
        return self._link.receive_newest(timeout, _parse_commands)

    def close(self) -> None:
        self._link.close()


def _parse_commands(packet: bytes) -> NDArray | None:
    layout = PACKET_LAYOUTS.get(int.from_bytes(packet[:2], "little"))
    if layout is None or len(packet) != struct.calcsize(layout):
        return None
    pulses = np.array(struct.unpack(layout, packet)[3:7], float)
    return np.clip((pulses - PULSE_MIN) / (PULSE_MAX - PULSE_MIN), 0, 1)
