"""Simulations that firmware flies: measurements out, motor commands in, for one process for each drone."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from crazysim.closing import Closing
from crazysim.control import Control
from crazysim.core.airframes import as_airframes
from crazysim.drones import Airframe
from crazysim.errors import ConfigError
from crazysim.live.attitude import rotate
from crazysim.live.pace import Pace, Speed
from crazysim.live.sitl.link import FirmwareLink
from crazysim.live.sitl.measured import Measured
from crazysim.plugins.sensors import GPS, IMU, Barometer, Magnetometer
from crazysim.sim import Sim

FIELD = np.array([0.0, 2e-5, -4.5e-5])
"""Magnetic field where there is no ``Magnetometer``, world frame, T: about that of central Europe."""


class SoftwareInTheLoop(Closing):
    """Processes of a firmware that fly the drones of a simulation, one each.

    A firmware receives what the plugins ``IMU``, ``Barometer``, ``Magnetometer`` and ``GPS`` of the simulation measure.
    Where there is none, an ``IMU`` without errors is added, and the others give the true values.
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
        """Prepare the simulation.

        Args:
            sim: Simulation at the level ``rotor_vel``.
            links: Links to the firmware, one for each drone, those of the first world first.
            freq: Exchanges per second, Hz, a divisor of ``sim.freq``; None for one in every step.
            motors: Meaning of a motor command from 0 to 1: part of the largest speed of a rotor, or of its thrust.
            reversed: True for a firmware that is set up for rotors that turn the other way round.
            timeout: Time to wait for the motor commands of a firmware in lockstep, s.

        Raises:
            ConfigError: If the level, the number of links, the rate or the rotors of an airframe do not fit.
        """
        self.sim, self.timeout, self.motors = sim, timeout, motors
        self.links = (links,) if isinstance(links, FirmwareLink) else tuple(links)
        freq = sim.freq if freq is None else freq
        if sim.control != Control.rotor_vel:
            raise ConfigError(
                f"expected control='rotor_vel', got {sim.control.value!r}. Use Sim(control='rotor_vel'), as a firmware "
                f"commands motors."
            )
        if len(self.links) != sim.n_worlds * sim.n_drones:
            raise ConfigError(
                f"expected a link for each of {sim.n_worlds * sim.n_drones} drones, got {len(self.links)}. "
                f"Pass one for each drone."
            )
        if motors not in ("speed", "thrust"):
            raise ConfigError(f"expected motors as 'speed' or 'thrust', got {motors!r}")
        if freq < 1 or sim.freq % freq:
            raise ConfigError(f"expected freq as a divisor of sim.freq={sim.freq}, got {freq}")
        self._n_steps = sim.freq // freq
        airframes = [*as_airframes(sim.airframes, sim.n_drones)] * sim.n_worlds
        self._orders = [motor_order(a, link, reversed) for a, link in zip(airframes, self.links, strict=True)]
        self._airframes, self._fastest = airframes, [airframe.rotor_vel_limits[1] for airframe in airframes]
        self._sensors: dict[type, Any] = {
            kind: next((p for p in sim.plugins.values() if isinstance(p, kind)), None)
            for kind in (IMU, Barometer, Magnetometer, GPS)
        }
        if self._sensors[IMU] is None:
            self._sensors[IMU] = sim.add(IMU())
        self._rotor_vel = np.zeros((len(self.links), 4), np.float32)
        self._exchanges = 0

    def run(self, seconds: float, speed: Speed | None = None) -> None:
        """Fly for a simulated time.

        Args:
            seconds: Simulated time, s.
            speed: Simulated seconds per second, or ``"max"``; None for real time with a firmware that has a clock
                of its own, and as fast as possible in lockstep.

        Raises:
            ConfigError: If a firmware in lockstep does not answer in time.
        """
        if speed is None:
            speed = "max" if all(link.lockstep for link in self.links) else 1.0
        dt = self._n_steps / self.sim.freq
        pace = Pace(dt, speed)
        for k in range(round(seconds / dt)):
            if (due := pace.due_in()) > 0:
                time.sleep(due)
            pace.begin(k * dt)
            self.exchange()
            self.sim.step(self._n_steps)

    def exchange(self) -> None:
        """Send measurements, and put the motor commands that come back in force."""
        for link, measured in zip(self.links, self.measure(), strict=True):
            link.send(measured)
        for k, link in enumerate(self.links):
            command = link.receive(self.timeout if link.lockstep else 0.0)
            if command is None and link.lockstep:
                raise ConfigError(
                    f"expected motor commands of {type(link).__name__} within {self.timeout:g} s, got none. Start the "
                    f"firmware, or set timeout."
                )
            if command is not None:
                self._rotor_vel[k] = self._speeds(k, command)
        self._exchanges += 1
        sim = self.sim
        sim.rotor_vel_control(self._rotor_vel.reshape(sim.n_worlds, sim.n_drones, 4))

    def measure(self) -> list[Measured]:
        """Return the measurements of every drone."""
        sim, states = self.sim, self.sim.data.states
        pos, quat, vel = (np.asarray(x, float).reshape(-1, x.shape[-1]) for x in (states.pos, states.quat, states.vel))
        height, field, gps = (self._latest(kind) for kind in (Barometer, Magnetometer, GPS))
        imu: Any = self._latest(IMU)
        found = []
        for k in range(len(self.links)):
            found.append(
                Measured(
                    time=self._exchanges * self._n_steps / sim.freq,
                    gyro=imu[k, :3],
                    accel=imu[k, 3:],
                    pos=pos[k],
                    quat=quat[k],
                    vel=vel[k],
                    gps_pos=pos[k] if gps is None else gps[k, :3],
                    gps_vel=vel[k] if gps is None else gps[k, 3:],
                    height=float(pos[k, 2] if height is None else height[k, 1]),
                    field=rotate(quat[k] * [-1, -1, -1, 1], FIELD) if field is None else field[k],
                )
            )
        return found

    def _latest(self, kind: type) -> NDArray | None:
        """Return the latest measurements of a sensor, true ones before the first; None without it. (n_links, k)"""
        sensor = self._sensors[kind]
        if sensor is None:
            return None
        samples = sensor.read(self.sim.data).samples
        value = np.asarray(samples.value, float)
        if np.any(np.asarray(samples.taken) < 0):
            observed = self.sim.plugins.observations(self.sim.data)
            value = np.concatenate([observed[f"{sensor.name}.{channel}"] for channel in sensor.channels], axis=-1)
        return value.reshape(-1, value.shape[-1])

    def close(self) -> None:
        """Close all links."""
        for link in self.links:
            link.close()

    def _speeds(self, k: int, command: NDArray) -> NDArray:
        """Return the speeds of the rotors of a drone for the motor commands of its firmware, rpm. (4,)"""
        of_rotors, airframe = np.zeros(4), self._airframes[k]
        of_rotors[self._orders[k]] = command
        if self.motors == "speed":
            return of_rotors * self._fastest[k]
        speeds = airframe.rotor_vel(of_rotors * float(airframe.value("rotors.thrust_max")))
        return np.where(of_rotors > 0, speeds, 0.0)


def motor_order(airframe: Airframe, link: FirmwareLink, reversed: bool = False) -> NDArray:
    """Return which rotor of an airframe each motor of a firmware drives. (4,)

    Raises:
        ConfigError: If the airframe has no rotor in a quadrant, or its rotors turn the other way round.
    """
    if airframe.n_rotors != 4:
        raise ConfigError(f"expected an airframe with 4 rotors, got {airframe.name!r} with {airframe.n_rotors}")
    signs = [tuple(map(int, np.sign(pos[:2]))) for pos in airframe.value("rotors.position")]
    if sorted(signs) != sorted(link.positions):
        raise ConfigError(
            f"expected a rotor in each quadrant of the body, got signs of x and y {signs}. Turn the frame."
        )
    order = np.array([signs.index(position) for position in link.positions])
    turns = tuple(map(int, airframe.value("rotors.yaw_torque_sign")[order]))
    expected = tuple(-sign if reversed else sign for sign in link.yaw_torque_signs)
    if turns != expected:
        raise ConfigError(
            f"expected rotors of {airframe.name!r} whose drag turns the body by {expected} about z, for motors 1 "
            f"to 4 of {type(link).__name__}, got {turns}. Pass reversed={not reversed}, and {link.remedy}."
        )
    return order
