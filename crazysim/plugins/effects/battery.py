"""Battery with a charge, a voltage that sags under load, and rotor speeds that the voltage limits or scales."""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.core.data import SimData, controls_of
from crazysim.core.plugin import (
    Param,
    Plugin,
    Simulation,
    StagePlacement,
    airframe_numbers,
    check_parameter,
    param,
    state,
)
from crazysim.dynamics.rotor import RPM_TO_RAD_S, quadratic_curve
from crazysim.eager import jit_eager_calls
from crazysim.plugins.effects.moving_air import needs_rotors
from crazysim.tables import POSITIVE

NOMINAL_VOLTAGE = 3.7
"""Nominal voltage of a lithium-polymer cell, V, as printed on cells; the voltage assumed for full rotor speed if an
airframe has no table ``[battery]``."""
MAX_CELLS = 100
"""Largest number of cells in series, the same limit as in airframes."""


class Battery(Plugin, replaces=("battery voltage",), requires=needs_rotors):
    """Batteries that the rotors discharge, with a voltage that limits the rotor speed; needs rotors.

    The voltage sags under load. The no-load speed of a DC motor is proportional to its voltage. Below
    ``full_speed_voltage`` the largest rotor speed is assumed to be proportional to the voltage too. An empty battery
    stops the rotors. Each number is one for all drones, (), or one per drone, (n_worlds, n_drones).
    """

    capacity: Param = param(default=None, airframe="battery.capacity", positive=True)
    """Charge of the full battery, A h; None for the value in the airframe's table ``[battery]``. (1,)"""
    resistance: Param = param(default=None, airframe="battery.resistance", positive=True)
    """Internal resistance of the whole battery, ohm; None for the value in the airframe's table ``[battery]``. (1,)"""
    n_cells: Param = param(
        default=None, airframe=lambda a: a.values.get("battery.cells", 1.0), low=1, high=MAX_CELLS, whole=True
    )
    """Number of lithium-polymer cells in series, a whole number; None for the value in the airframe's table
    ``[battery]``, or 1. (1,)"""
    efficiency: Param = param(default=1.0, high=1.0, positive=True)
    """Mechanical power of the propellers per electric power of the motors, above 0, up to 1. (1,)"""
    base_power: Param = param(default=0.0, low=0.0)
    """Electric power of everything but the motors, W. (1,)"""
    full_speed_voltage: Param = param(default=None, positive=True)
    """Least voltage at which the rotors reach the airframe's largest speed, V; None for the value in the airframe's
    table ``[battery]`` (2.8 to 3.4 V for Crazyflies), or else 3.7 V per cell. (1,)"""
    charge: Param = param(default=1.0, scope="drone", low=0.0, high=1.0)
    """State of charge, 0 to 1; of the plugin that is added, at the beginning of an episode. (n_worlds, n_drones, 1)"""
    command_voltage: Param = param(default=None, positive=True)
    """Voltage at which rotors turn as commanded, V, for firmware that does not compensate for the voltage: the speeds
    are proportional to it. None for firmware that compensates. (1,)"""
    rounding: Array = state()
    """Rounding error of the charge, subtracted at the next step, 1. (n_worlds, n_drones, 1)"""
    voltage: Array = state()
    """Voltage under load, V. (n_worlds, n_drones, 1)"""
    current: Array = state()
    """Current, A. (n_worlds, n_drones, 1)"""
    name: str = "battery"

    def bind(self, sim: Simulation) -> Battery:
        bound = self.with_arrays(sim)
        full_speed_voltage = self.full_speed_voltage
        if full_speed_voltage is None:
            voltage = airframe_numbers(sim, lambda a: a.full_thrust_voltage or 0.0)[..., None]
            full_speed_voltage = np.where(voltage > 0, voltage, NOMINAL_VOLTAGE * np.asarray(bound.n_cells))
        return bound.replace(
            voltage=open_circuit_voltage(bound.charge, bound.n_cells),
            full_speed_voltage=check_parameter(sim, "full_speed_voltage", full_speed_voltage, allowed=POSITIVE),
        )

    def stages(self, sim: Simulation) -> Sequence[StagePlacement]:
        return [StagePlacement(self.stage(self.discharge))]

    def influence(self, data: SimData) -> SimData:
        controls = controls_of(data)
        speed_ratio = self.voltage / self.full_speed_voltage
        speed_ratio = jnp.where(self.charge > 0, jnp.where(speed_ratio < 1, speed_ratio, 1.0), 0.0)
        limit = speed_ratio * data.params.rotor_vel_max
        rotor_vel = controls.rotor_vel
        if self.command_voltage is not None:
            rotor_vel = rotor_vel * (self.voltage / self.command_voltage)
        rotor_vel = jnp.where(rotor_vel > limit, limit, rotor_vel)
        return data.replace(controls=controls.replace(rotor_vel=rotor_vel))

    def observations(self, data: SimData) -> dict[str, Array]:
        return {"voltage": self.voltage, "charge": self.charge}

    def discharge(self, data: SimData) -> SimData:
        """Draw the energy of one step for the rotors and electronics of one drone.

        The power of a rotor is drag torque times angular velocity; the power that accelerates it is neglected. An
        empty battery supplies nothing.
        """
        p, rotor_vel = data.params, data.states.rotor_vel
        # Electric power of rotors and electronics.
        mechanical_power = jnp.sum(
            quadratic_curve(rotor_vel, p.rpm2torque) * rotor_vel * RPM_TO_RAD_S, axis=-1, keepdims=True
        )
        power = jnp.where(mechanical_power > 0, mechanical_power, 0.0) / self.efficiency + self.base_power
        power = jnp.where(self.charge > 0, power, 0.0)
        voltage, current = voltage_under_load(power, open_circuit_voltage(self.charge, self.n_cells), self.resistance)

        # Compensated summation (Kahan 1965): in float32 most of the millionths that a step draws would be rounded off.
        charge_used = current / (3600.0 * data.core.freq * self.capacity) + self.rounding
        charge = self.charge - charge_used
        rounding = charge_used - (self.charge - charge)
        is_empty = charge <= 0
        battery = self.replace(
            charge=jnp.where(is_empty, 0.0, charge),
            rounding=jnp.where(is_empty, 0.0, rounding),
            voltage=voltage,
            current=current,
        )
        return self.write(data, battery)


@jit_eager_calls()
def open_circuit_voltage(charge: Array, n_cells: Array) -> Array:
    """Return the open-circuit voltage of lithium-polymer cells in series, V.

    Chen and Rincon-Mora 2006 (IEEE Trans. Energy Conversion 21(2)), equation 2, fitted to one cell: 4.10 V when full,
    3.8 V at half charge, with a steep fall below a tenth.

    Args:
        charge: State of charge, 0 to 1. (..., 1)
        n_cells: Number of cells. (1,) or (..., 1)
    """
    polynomial = 3.685 + charge * (0.2156 + charge * (-0.1178 + charge * 0.3201))
    return n_cells * (polynomial - 1.031 * jnp.exp(-35.0 * charge))


def voltage_under_load(power: Array, open_circuit: Array, resistance: Array) -> tuple[Array, Array]:
    """Return the voltage, V, and current, A, of a source with internal resistance that supplies a power.

    The voltage is the larger root of ``V = V_0 - R P / V``. The source supplies ``V_0^2 / (4 R)`` at most, at half the
    open-circuit voltage; larger loads get that much power.

    Args:
        power: Power of the load, W. (..., 1)
        open_circuit: Voltage without load, V. (..., 1)
        resistance: Internal resistance, ohm. (..., 1)
    """
    discriminant = open_circuit * open_circuit - 4 * resistance * power
    is_feasible = discriminant > 0
    root = jnp.where(is_feasible, jnp.sqrt(jnp.where(is_feasible, discriminant, 1.0)), 0.0)
    voltage = 0.5 * (open_circuit + root)
    max_power = open_circuit * open_circuit / (4 * resistance)
    return voltage, jnp.where(is_feasible, power, max_power) / voltage
