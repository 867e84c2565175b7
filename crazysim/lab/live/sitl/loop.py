"""Simulations flown by firmware: a process for each drone receives measurements and sends motor commands."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from crazysim.arguments import check_flag
from crazysim.control import Control
from crazysim.core.airframes import as_airframes
from crazysim.core.settings import dividing_rate
from crazysim.drones import Airframe
from crazysim.errors import ConfigError, require, short_repr
from crazysim.lab.live.attitude import rotate
from crazysim.lab.live.pace import Pace, Speed
from crazysim.lab.live.sitl.link import ROUNDING_TOLERANCE, FirmwareLink
from crazysim.lab.live.sitl.measured import Measurements
from crazysim.lab.live.staging import compile_step
from crazysim.plugins.sensors import GPS, IMU, Barometer, Magnetometer
from crazysim.plugins.sensors.sensor import Sensor
from crazysim.sim import Sim
from crazysim.storage import Closeable
from crazysim.tables import NOT_NEGATIVE, TIMEOUT_RANGE, read_number

MAGNETIC_FIELD = np.array([0.0, 2e-5, -4.5e-5])
"""Magnetic field without a ``Magnetometer``, world frame, T: roughly the field in central Europe."""
SILENCE_LIMIT = 1.0
"""Duration of a run beyond which every firmware must have sent motor commands, s."""
GPS_FREQ = 5
"""Rate of satellite navigation without a ``GPS``, Hz."""
SENSOR_KINDS = (IMU, Barometer, Magnetometer, GPS)
"""Sensors whose measurements are sent to firmware."""
MOUNTED_SENSORS = (IMU, Magnetometer)
"""Sensors whose frame may be rotated relative to the body."""


class SoftwareInTheLoop(Closeable):
    """Processes of a firmware that fly the drones of a simulation, one process for each drone.

    The plugins ``IMU``, ``Barometer``, ``Magnetometer`` and ``GPS`` of the simulation provide the measurements. If the
    ``IMU`` is missing, one without errors is added; if another sensor is missing, the true values are sent. The
    docstring of each link states which measurements its firmware receives.
    """

    def __init__(
        self,
        sim: Sim,
        links: FirmwareLink | Sequence[FirmwareLink],
        *,
        freq: int | None = None,
        motors: Literal["speed", "thrust"] = "speed",
        reversed: bool = False,
        timeout: float = 10.0,
    ):
        self.sim, self.timeout, self.motors = sim, read_number("timeout", timeout, TIMEOUT_RANGE), motors
        self.links = _check_links(links)
        freq = sim.freq if freq is None else dividing_rate("freq", freq, sim.freq)
        require(
            sim.control == Control.rotor_vel,
            f"expected control='rotor_vel', got {sim.control.value!r}. Use Sim(control='rotor_vel'), as a firmware "
            f"commands motors.",
        )
        require(
            len(self.links) == sim.n_worlds * sim.n_drones,
            f"expected a link for each of {sim.n_worlds * sim.n_drones} drones, got {len(self.links)}. "
            f"Pass one for each drone.",
        )
        require(motors in ("speed", "thrust"), f"expected motors as 'speed' or 'thrust', got {motors!r}")
        reversed = check_flag("reversed", reversed)
        self._n_steps = sim.freq // freq
        airframes = [*as_airframes(sim.airframes, sim.n_drones)] * sim.n_worlds
        self._orders = [motor_order(a, link, reversed) for a, link in zip(airframes, self.links, strict=True)]
        self._airframes, self._max_rotor_vel = airframes, [airframe.rotor_vel_limits[1] for airframe in airframes]
        self._sensors: dict[type, Any] = {
            kind: next((p for p in sim.plugins.values() if isinstance(p, kind)), None) for kind in SENSOR_KINDS
        }
        if self._sensors[IMU] is None:
            self._sensors[IMU] = sim.add(IMU())
        self._rotor_vel = np.zeros((len(self.links), 4), np.float32)
        self._sample_numbers: NDArray | None = None
        self._last_command_times = [0.0] * len(self.links)
        self._n_exchanges = 0
        self._is_compiled = False

    def run(self, seconds: float, speed: Speed | None = None) -> None:
        """Fly for a simulated time.

        Args:
            seconds: Simulated time, s.
            speed: Simulated seconds per second, or ``"max"``; None for real time with a firmware that has a clock
                of its own, and as fast as possible in lockstep.
        """
        seconds = read_number("seconds", seconds, NOT_NEGATIVE)
        if speed is None:
            speed = "max" if all(link.lockstep for link in self.links) else 1.0
        if not self._is_compiled:  # without lockstep, a firmware does not wait for compilation
            compile_step(self.sim, self._n_steps)
            self._is_compiled = True
        dt, start_time = self._n_steps / self.sim.freq, time.monotonic()
        self._last_command_times = [start_time] * len(self.links)
        pace = Pace(dt, speed, time.perf_counter)
        for k in range(round(seconds / dt)):
            if (wait := pace.time_until_due()) > 0:
                time.sleep(wait)
            pace.record_step(k * dt)
            self.exchange()
            self._check_commands_arrived(time.monotonic() - self.timeout, self.timeout)
            self.sim.step(self._n_steps)
        if seconds > SILENCE_LIMIT and (elapsed := time.monotonic() - start_time) > SILENCE_LIMIT:
            self._check_commands_arrived(start_time, elapsed)

    def exchange(self) -> None:
        """Send measurements, and apply the motor commands that come back."""
        measured, self._sample_numbers = self._read_measurements()
        for link, measurements in zip(self.links, measured, strict=True):
            link.send(measurements)
        for k, link in enumerate(self.links):
            command = link.receive(self.timeout if link.lockstep else 0.0)
            if command is not None:
                self._rotor_vel[k] = self._to_rotor_speeds(k, command)
                self._last_command_times[k] = time.monotonic()
            elif link.lockstep:
                raise _silence_error(link, self.timeout)
        self._n_exchanges += 1
        sim = self.sim
        sim.rotor_vel_control(self._rotor_vel.reshape(sim.n_worlds, sim.n_drones, 4))

    def measure(self) -> list[Measurements]:
        """Return the measurements of every drone; ``new`` contains the sensors with data since the last exchange."""
        return self._read_measurements()[0]

    def _read_measurements(self) -> tuple[list[Measurements], NDArray]:
        states, time_now = self.sim.data.states, self._n_exchanges * self._n_steps / self.sim.freq
        pos, quat, vel, ang_vel = (_flatten_drones(x) for x in (states.pos, states.quat, states.vel, states.ang_vel))
        # Measured values, or true ones without a sensor.
        values, steps_taken = zip(*map(self._latest_values, SENSOR_KINDS), strict=True)
        imu, height, field, gps = values
        if field is None:
            field = rotate(quat * [-1, -1, -1, 1], MAGNETIC_FIELD)
        gps = np.concatenate([pos, vel], axis=-1) if gps is None else gps
        # Sensors with a new sample since the last exchange.
        default_numbers: dict[type[Sensor], int] = {GPS: math.floor(time_now * GPS_FREQ + ROUNDING_TOLERANCE)}
        sample_numbers = np.empty((len(self.links), len(SENSOR_KINDS)), np.int64)
        for k, kind in enumerate(SENSOR_KINDS):
            is_missing = steps_taken[k] is None
            sample_numbers[:, k] = default_numbers.get(kind, self._n_exchanges) if is_missing else steps_taken[k]
        is_new = (
            np.ones_like(sample_numbers, bool)
            if self._sample_numbers is None
            else sample_numbers != self._sample_numbers
        )
        measurements = []
        for k in range(len(self.links)):
            measurements.append(
                Measurements(
                    time=time_now,
                    gyro=imu[k, :3],
                    accel=imu[k, 3:],
                    pos=pos[k],
                    quat=quat[k],
                    vel=vel[k],
                    ang_vel=ang_vel[k],
                    gps_pos=gps[k, :3],
                    gps_vel=gps[k, 3:],
                    height=float(pos[k, 2] if height is None else height[k, 1]),
                    field=field[k],
                    new=frozenset(kind for kind, is_changed in zip(SENSOR_KINDS, is_new[k], strict=True) if is_changed),
                )
            )
        return measurements, sample_numbers

    def _latest_values(self, kind: type[Sensor]) -> tuple[Any, NDArray | None]:
        # Before the first measurement, they are the values of a perfect sensor. Without the sensor, both are None.
        sensor = self._sensors[kind]
        if sensor is None:
            return None, None
        record = sensor.read(self.sim.data)
        value, taken = np.asarray(record.samples.value, float), np.asarray(record.samples.taken_step).reshape(-1)
        if taken.min() < 0:
            observed = self.sim.plugins.observations(self.sim.data)
            value = np.concatenate([observed[f"{sensor.name}.{name}"] for name in sensor.channels], axis=-1)
        if kind in MOUNTED_SENSORS:
            vectors = value.reshape(*value.shape[:-1], -1, 3)
            value = rotate(np.asarray(record.quat, float)[..., None, :], vectors).reshape(value.shape)
        return _flatten_drones(value), taken

    def _check_commands_arrived(self, start_time: float, seconds: float) -> None:
        for link, last_time in zip(self.links, self._last_command_times, strict=True):
            if last_time <= start_time:
                raise _silence_error(link, seconds)

    def close(self) -> None:
        for link in self.links:
            link.close()

    def _to_rotor_speeds(self, k: int, command: NDArray) -> NDArray:
        rotor_commands, airframe = np.zeros(4), self._airframes[k]
        rotor_commands[self._orders[k]] = command
        if self.motors == "speed":
            return rotor_commands * self._max_rotor_vel[k]
        speeds = airframe.rotor_vel(rotor_commands * float(airframe.value("rotors.thrust_max")))
        return np.where(rotor_commands > 0, speeds, 0.0)


def _check_links(links: object) -> tuple[FirmwareLink, ...]:
    sequence = (links,) if isinstance(links, FirmwareLink) else links
    if not isinstance(sequence, Sequence) or not all(isinstance(link, FirmwareLink) for link in sequence):
        raise ConfigError(
            f"expected a link to firmware or a list of them, got {short_repr(links)}. Use ArduPilot(), say."
        )
    require(
        len(set(map(id, sequence))) == len(sequence),
        f"expected one link for each of {len(sequence)} drones, got one twice. Create each with its own ports.",
    )
    return tuple(sequence)


def _flatten_drones(values: Any) -> NDArray:
    values = np.asarray(values, float)
    return values.reshape(-1, values.shape[-1])


def _silence_error(link: FirmwareLink, seconds: float) -> ConfigError:
    return ConfigError(
        f"expected motor commands of {type(link).__name__} within {seconds:.3g} s, got none. Start the firmware, or "
        f"set timeout."
    )


def motor_order(airframe: Airframe, link: FirmwareLink, reversed: bool = False) -> NDArray:
    """Return the index of the rotor of an airframe that each motor of a firmware drives. (4,)"""
    require(
        airframe.n_rotors == 4, f"expected an airframe with 4 rotors, got {airframe.name!r} with {airframe.n_rotors}"
    )
    signs = [tuple(map(int, np.sign(pos[:2]))) for pos in airframe.value("rotors.position")]
    require(
        sorted(signs) == sorted(link.positions),
        f"expected a rotor in each quadrant of the body, got signs of x and y {signs}. Turn the frame.",
    )
    order = np.array([signs.index(position) for position in link.positions])
    torque_signs = tuple(map(int, airframe.value("rotors.yaw_torque_sign")[order]))
    expected = tuple(-sign if reversed else sign for sign in link.yaw_torque_signs)
    if torque_signs != expected:
        change = (
            "reversed=False, with the firmware's default senses" if reversed else f"reversed=True, and {link.remedy}"
        )
        raise ConfigError(
            f"expected rotors of {airframe.name!r} whose drag turns the body by {expected} about z, for motors 1 "
            f"to 4 of {type(link).__name__}, got {torque_signs}. Pass {change}."
        )
    return order
