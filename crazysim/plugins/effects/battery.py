"""Battery with a charge, a voltage that sags under load, and rotor speeds that the voltage limits or scales."""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from crazysim.core.data import SimData, controls_of
from crazysim.core.plugin import (
    Plugin,
    Simulation,
    StagePlacement,
    airframe_numbers,
    check_parameter,
    drone_array,
    parameter,
)
from crazysim.core.stage import stage
from crazysim.dynamics.rotor import RPM_TO_RAD_S, quadratic_curve
from crazysim.eager import jit_eager_calls
from crazysim.plugins.effects.moving_air import require_rotors
from crazysim.pytree import PyTree, leaf

NOMINAL_VOLTAGE = 3.7
"""Nominal voltage of a lithium-polymer cell, V, as printed on cells; the voltage assumed for full rotor speed if an
airframe has no table ``[battery]``."""
MAX_CELLS = 100
"""Largest number of cells in series, the same limit as in airframes."""


class BatteryData(PyTree):
    """State and parameters of the battery of every drone."""

    charge: Array = leaf("drone", 1)
    """State of charge, 0 to 1. (n_worlds, n_drones, 1)"""
    rounding: Array = leaf("drone", 1, (1,))
    """Rounding error of the charge, subtracted at the next step, 1. (n_worlds, n_drones, 1)"""
    voltage: Array = leaf("drone", 1)
    """Voltage under load, V. (n_worlds, n_drones, 1)"""
    current: Array = leaf("drone", 1, (1,))
    """Current, A. (n_worlds, n_drones, 1)"""
    capacity: Array = leaf("parameter", 1, (1,))
    """Charge of the full battery, A h. (1,)"""
    resistance: Array = leaf("parameter", 1, (1,))
    """Internal resistance, ohm. (1,)"""
    efficiency: Array = leaf("parameter", 1, (1,))
    """Mechanical power of the propellers per electric power of the motors, 0 to 1. (1,)"""
    base_power: Array = leaf("parameter", 1, (1,))
    """Electric power of everything but the motors, W. (1,)"""
    full_speed_voltage: Array = leaf("parameter", 1, (1,))
    """Least voltage at which the rotors reach the airframe's largest speed, V. (1,)"""
    n_cells: Array = leaf("parameter", 1, (1,))
    """Number of cells in series. (1,)"""
    command_voltage: Array | None = leaf("parameter", 1, (1,))
    """Voltage at which the rotors turn as commanded, V; None if they do so at any voltage. (1,)"""


class Battery(Plugin):
    """Batteries that the rotors discharge, with a voltage that limits the rotor speed; needs rotors.

    The voltage sags under load. The no-load speed of a DC motor is proportional to its voltage. Below
    ``full_speed_voltage`` the largest rotor speed is assumed to be proportional to the voltage too. An empty battery
    stops the rotors. Each parameter is one number for all drones, (), or one number per drone, (n_worlds, n_drones).
    """

    capacity: ArrayLike | None = parameter(default=None, positive=True)
    """Charge of the full battery, A h; None for the value in the airframe's table ``[battery]``."""
    resistance: ArrayLike | None = parameter(default=None, positive=True)
    """Internal resistance of the whole battery, ohm; None for the value in the airframe's table ``[battery]``."""
    n_cells: ArrayLike | None = parameter(default=None, low=1, high=MAX_CELLS, dtype=np.int32)
    """Number of lithium-polymer cells in series; None for the value in the airframe's table ``[battery]``, or 1."""
    efficiency: ArrayLike = parameter(default=1.0, high=1.0, positive=True)
    """Mechanical power of the propellers per electric power of the motors, above 0, up to 1."""
    base_power: ArrayLike = parameter(default=0.0, low=0.0)
    """Electric power of everything but the motors, W."""
    full_speed_voltage: ArrayLike | None = parameter(default=None, positive=True)
    """Least voltage at which the rotors reach the airframe's largest speed, V; None for the value in the airframe's
    table ``[battery]`` (2.8 to 3.4 V for Crazyflies), or else 3.7 V per cell."""
    charge: ArrayLike = parameter(default=1.0, low=0.0, high=1.0)
    """State of charge at the beginning of an episode, 0 to 1."""
    command_voltage: ArrayLike | None = parameter(default=None, positive=True)
    """Voltage at which rotors turn as commanded, V, for firmware that does not compensate for the voltage: the speeds
    are proportional to it. None for firmware that compensates."""
    name: str = "battery"

    @property
    def replaced_terms(self) -> tuple[str, ...]:
        return ("battery voltage",)

    def record(self, sim: Simulation) -> BatteryData:
        require_rotors(sim, "battery sag")
        n_cells = self.n_cells
        if n_cells is None:
            n_cells = airframe_numbers(sim, lambda a: a.values.get("battery.cells", np.ones(())).astype(int))
        counts = check_parameter(sim, "n_cells", n_cells, (1,), 1, dtype=jnp.int32)
        cells = counts.astype(sim.data.states.pos.dtype)
        full_speed_voltage = self.full_speed_voltage
        if full_speed_voltage is None:
            voltage = airframe_numbers(sim, lambda a: a.full_thrust_voltage or 0.0)
            full_speed_voltage = np.where(
                voltage[..., None] > 0, voltage[..., None], NOMINAL_VOLTAGE * np.asarray(cells)
            )
        charge = drone_array(sim, check_parameter(sim, "charge", self.charge, (1,), 0.0, 1.0), 1)
        return self.fill_record(
            sim,
            BatteryData,
            charge=charge,
            voltage=open_circuit_voltage(charge, cells),
            capacity=check_parameter(sim, "capacity", self._setting_or_airframe_value(sim, "capacity"), positive=True),
            resistance=check_parameter(
                sim, "resistance", self._setting_or_airframe_value(sim, "resistance"), positive=True
            ),
            full_speed_voltage=check_parameter(sim, "full_speed_voltage", full_speed_voltage, positive=True),
            n_cells=cells,
        )

    def _setting_or_airframe_value(self, sim: Simulation, key: str) -> ArrayLike:
        """Return the setting ``key``, or the airframes' value if the setting is None."""
        value = getattr(self, key)
        return airframe_numbers(sim, lambda a: a.value(f"battery.{key}", ())) if value is None else value

    def stages(self, sim: Simulation) -> Sequence[StagePlacement]:
        return [StagePlacement(stage("drone")(self.discharge))]

    def influence(self, data: SimData) -> SimData:
        battery, controls = self.read(data), controls_of(data)
        speed_ratio = battery.voltage / battery.full_speed_voltage
        speed_ratio = jnp.where(battery.charge > 0, jnp.where(speed_ratio < 1, speed_ratio, 1.0), 0.0)
        limit = speed_ratio * data.params.rotor_vel_max
        rotor_vel = controls.rotor_vel
        if battery.command_voltage is not None:
            rotor_vel = rotor_vel * (battery.voltage / battery.command_voltage)
        rotor_vel = jnp.where(rotor_vel > limit, limit, rotor_vel)
        return data.replace(controls=controls.replace(rotor_vel=rotor_vel))

    def observations(self, data: SimData) -> dict[str, Array]:
        """Return the voltage, V, and the state of charge."""
        battery = self.read(data)
        return {"voltage": battery.voltage, "charge": battery.charge}

    def discharge(self, data: SimData) -> SimData:
        """Draw the energy of one step for the rotors and electronics of one drone.

        The power of a rotor is drag torque times angular velocity; the power that accelerates it is neglected. An
        empty battery supplies nothing.
        """
        battery, p, rotor_vel = self.read(data), data.params, data.states.rotor_vel
        mechanical_power = jnp.sum(
            quadratic_curve(rotor_vel, p.rpm2torque) * rotor_vel * RPM_TO_RAD_S, axis=-1, keepdims=True
        )
        power = jnp.where(mechanical_power > 0, mechanical_power, 0.0) / battery.efficiency + battery.base_power
        power = jnp.where(battery.charge > 0, power, 0.0)
        voltage, current = voltage_under_load(
            power, open_circuit_voltage(battery.charge, battery.n_cells), battery.resistance
        )

        # Compensated summation (Kahan 1965): in float32 most of the millionths that a step draws would be rounded off.
        charge_used = current / (3600.0 * data.core.freq * battery.capacity) + battery.rounding
        charge = battery.charge - charge_used
        rounding = charge_used - (battery.charge - charge)
        is_empty = charge <= 0
        battery = battery.replace(
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
