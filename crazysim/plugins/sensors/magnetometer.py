"""Magnetometer: the magnetic field of the earth in the sensor's frame, with the errors of three axes."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.plugin import Simulation, parameter
from crazysim.core.random import normal
from crazysim.errors import ConfigError, short_repr
from crazysim.plugins.sensors.sensor import Samples, Sensor, mounting_quat
from crazysim.plugins.sensors.triad import Triad, TriadData
from crazysim.pytree import PyTree, leaf

MAX_FIELD = 1e-3
"""Strongest field accepted, T, about fifteen times the field of the earth, so that fields in other units are rejected.
An assumption."""


class MagnetometerData(PyTree):
    """State and parameters of the magnetometer of every drone."""

    samples: Samples
    """Measurements."""
    errors: TriadData
    """Errors, T."""
    field: Array = leaf("parameter", 1, (3,))
    """Magnetic field, world frame, T. (3,)"""
    quat: Array = leaf("parameter", 1, (4,), sparse=True)
    """Attitude of the sensor, sensor to body, unit, xyzw. (4,)"""


class Magnetometer(Sensor):
    """Magnetic field in the sensor's frame, T. The bias in ``errors`` is known as hard iron."""

    field: ArrayLike = parameter()
    """Magnetic field, world frame, T: (0, 2e-5, -4.5e-5) with x east, y north and z up has the magnitude of the field
    in central Europe (an estimate; take yours from the World Magnetic Model). (3,) or (n_worlds, n_drones, 3)"""
    errors: Triad = parameter(default=Triad())
    """Errors of the three axes, T."""
    rpy: ArrayLike = parameter(default=(0.0, 0.0, 0.0))
    """Roll, pitch and yaw of the sensor in the body frame, rad. (3,) or (n_worlds, n_drones, 3)"""
    _: dataclasses.KW_ONLY
    freq: int | None = 20
    """Measurements per second, Hz, a divisor of ``sim.freq``; None for every step."""
    name: str = "magnetometer"

    @property
    def channels(self) -> Mapping[str, int]:
        return {"field": 3}

    def record(self, sim: Simulation) -> MagnetometerData:
        field = np.asarray(self.field)
        if field.dtype.kind in "iuf" and np.any(np.abs(field) > MAX_FIELD):
            raise ConfigError(
                f"expected field in tesla, of at most {MAX_FIELD} T along an axis, got {short_repr(self.field)}. "
                f"Use 20e-6 for 20 microtesla, 1e-4 for one gauss."
            )
        errors, quat = self.errors.record(sim, "errors"), mounting_quat(sim, self.rpy)
        return self.fill_record(sim, MagnetometerData, errors=errors, quat=quat)

    def ideal(self, data: SimData) -> Array:
        """Return the field in the sensor's frame, T. (3,)"""
        record = self.read(data)
        return rotation.rotate_inverse(rotation.multiply(data.states.quat, record.quat), record.field)

    def reset_episode(self, data: SimData) -> SimData:
        record, truth = self.read(data), self.ideal(data)
        errors = record.errors.draw_errors(truth, normal(self.episode_key(data), (12,), truth.dtype))
        return self.write(data, record.replace(errors=errors))

    def measure(self, data: SimData, record: MagnetometerData, key: Array) -> tuple[Array, MagnetometerData]:
        truth = self.ideal(data)
        value, errors = record.errors.measure(truth, normal(key, (9,), truth.dtype), self.interval(data))
        return value, record.replace(errors=errors)
