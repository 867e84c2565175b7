"""Magnetometer: the magnetic field of the earth in the sensor's frame, with the errors of three axes."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.plugin import Param, Simulation, derived, nested, param
from crazysim.errors import ConfigError, short_repr
from crazysim.plugins.sensors.sensor import Sensor, mounting_quat
from crazysim.plugins.sensors.triad import Triad, TriadErrors

MAX_FIELD = 1e-3
"""Strongest field accepted, T, about fifteen times the field of the earth, so that fields in other units are rejected.
An assumption."""


class Magnetometer(Sensor):
    """Magnetic field in the sensor's frame, T. The bias in ``errors`` is known as hard iron."""

    field: Param = param(core=(3,))
    """Magnetic field, world frame, T: (0, 2e-5, -4.5e-5) with x east, y north and z up has the magnitude of the field
    in central Europe (an estimate; take yours from the World Magnetic Model). (3,)"""
    errors: Triad = nested(default=Triad())
    """Errors of the three axes, T."""
    rpy: Param = param(default=(0.0, 0.0, 0.0), core=(3,), keep=False)
    """Roll, pitch and yaw of the sensor in the body frame, rad. (3,) or (n_worlds, n_drones, 3)"""
    _: dataclasses.KW_ONLY
    quat: Array = derived((4,), sparse=True)
    """Attitude of the sensor, sensor to body, unit, xyzw. (4,)"""
    freq: int | None = 20
    """Measurements per second, Hz, a divisor of ``sim.freq``; None for every step."""
    name: str = "magnetometer"

    channels: ClassVar = {"field": 3}
    chains: ClassVar = {"field": [TriadErrors("errors")]}

    def bind(self, sim: Simulation) -> Magnetometer:
        field = np.asarray(self.field)
        if field.dtype.kind in "iuf" and np.any(np.abs(field) > MAX_FIELD):
            raise ConfigError(
                f"expected field in tesla, of at most {MAX_FIELD} T along an axis, got {short_repr(self.field)}. "
                f"Use 20e-6 for 20 microtesla, 1e-4 for one gauss."
            )
        return self.with_arrays(sim, errors=self.errors.bind(sim, "errors"), quat=mounting_quat(sim, self.rpy))

    def ideal(self, data: SimData) -> Array:
        return rotation.rotate_inverse(rotation.multiply(data.states.quat, self.quat), self.field)
