"""Battery: charge that is used up, and a voltage that sags under load and takes rotor speed with it."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import Array

from crazysim.core.data import SimData
from crazysim.core.stage import stage
from crazysim.dynamics.rotor import RPM_TO_RAD_S, curve
from crazysim.effects.core import Simulation, as_setting, controls_of, install, per_drone, require_rotors, zeros
from crazysim.pytree import PyTree, leaf, static

NOMINAL_VOLTAGE = 3.7
"""Nominal voltage of a lithium-polymer cell, V, as printed on cells: assumed for full rotor speed where an airframe has
no table ``[battery]``."""


class Battery(PyTree):
    """State of the battery of every drone, and what it is."""

    charge: Array = leaf("drone", 1)
    """State of charge, 0 to 1. (n_worlds, n_drones, 1)"""
    rounding: Array = leaf("drone", 1)
    """What rounding has added to the charge so far, and the next step takes back, 1. (n_worlds, n_drones, 1)"""
    voltage: Array = leaf("drone", 1)
    """Voltage under the present load, V. (n_worlds, n_drones, 1)"""
    current: Array = leaf("drone", 1)
    """Present current, A. (n_worlds, n_drones, 1)"""
    capacity: Array = leaf("parameter", 1, (1,))
    """Charge of the full battery, A h. (1,)"""
    resistance: Array = leaf("parameter", 1, (1,))
    """Internal resistance, ohm. (1,)"""
    efficiency: Array = leaf("parameter", 1, (1,))
    """Mechanical power of the propellers per electric power of the motors, 0 to 1. (1,)"""
    base_power: Array = leaf("parameter", 1, (1,))
    """Electric power of everything but the motors, W. (1,)"""
    full_speed_voltage: Array = leaf("parameter", 1, (1,))
    """Voltage from which on the rotors reach the airframe's largest speed, V. (1,)"""
    n_cells: int = static()
    """Number of cells in series."""


def add(
    sim: Simulation,
    capacity: Any,
    resistance: Any,
    n_cells: int = 1,
    efficiency: Any = 1.0,
    base_power: Any = 0.0,
    full_speed_voltage: Any = None,
    charge: Any = 1.0,
) -> None:
    """Let drones fly on batteries: rotors draw power, the voltage sags, and the largest rotor speed with it.

    Settings are for all drones, (), or for each, (n_worlds, n_drones).

    Args:
        sim: The simulation, with first-principles dynamics.
        capacity: Charge of the full battery, A h.
        resistance: Internal resistance of the whole battery, ohm.
        n_cells: Number of lithium-polymer cells in series.
        efficiency: Mechanical power of the propellers per electric power of the motors, above 0, up to 1.
        base_power: Electric power of everything but the motors, W.
        full_speed_voltage: Voltage from which on the rotors reach the airframe's largest speed, V; None for that of the
            airframe's table ``[battery]`` (2.8 to 3.4 V for Crazyflies), or else the nominal 3.7 V per cell.
        charge: State of charge at the beginning of an episode, 0 to 1.

    Raises:
        ConfigError: If a setting cannot be, the dynamics have no rotors, or the drones have batteries already.
    """
    require_rotors(sim, "battery sag")
    cells = int(as_setting(sim, "n_cells", n_cells, (1,), 1, dtype=jnp.int32).item())
    if full_speed_voltage is None:
        full_speed_voltage = sim.airframe.full_thrust_voltage or NOMINAL_VOLTAGE * cells
    full = per_drone(sim, as_setting(sim, "charge", charge, (1,), 0.0, 1.0))
    record = Battery(
        charge=full,
        rounding=zeros(sim, 1),
        voltage=open_circuit_voltage(full, cells),
        current=zeros(sim, 1),
        capacity=as_setting(sim, "capacity", capacity, positive=True),
        resistance=as_setting(sim, "resistance", resistance, positive=True),
        efficiency=as_setting(sim, "efficiency", efficiency, high=1.0, positive=True),
        base_power=as_setting(sim, "base_power", base_power, low=0.0),
        full_speed_voltage=as_setting(sim, "full_speed_voltage", full_speed_voltage, positive=True),
        n_cells=cells,
    )
    install(sim, "battery", record, discharge, limit_rotor_vel)


def limit_rotor_vel(data: SimData) -> SimData:
    """Return the data with rotor commands within what the voltage allows; an empty battery turns no rotor.

    The no-load speed of a DC motor is proportional to its voltage, and so is taken to be the largest speed below
    ``full_speed_voltage``.
    """
    battery, controls = data.plugins["battery"], controls_of(data)
    share = battery.voltage / battery.full_speed_voltage
    share = jnp.where(battery.charge > 0, jnp.where(share < 1, share, 1.0), 0.0)
    limit = share * data.params.rotor_vel_max
    rotor_vel = jnp.where(controls.rotor_vel > limit, limit, controls.rotor_vel)
    return data.replace(controls=controls.replace(rotor_vel=rotor_vel))


@stage("drone")
def discharge(data: SimData) -> SimData:
    """Draw the power of one drone's rotors and electronics from its battery for a step.

    Rotors need drag torque times angular velocity; what speeding them up takes is left out. An empty battery gives
    nothing.
    """
    battery, p, rotor_vel = data.plugins["battery"], data.params, data.states.rotor_vel
    mechanical = jnp.sum(curve(rotor_vel, p.rpm2torque) * rotor_vel * RPM_TO_RAD_S, axis=-1, keepdims=True)
    power = jnp.where(mechanical > 0, mechanical, 0.0) / battery.efficiency + battery.base_power
    power = jnp.where(battery.charge > 0, power, 0.0)
    voltage, current = under_load(power, open_circuit_voltage(battery.charge, battery.n_cells), battery.resistance)

    # Compensated summation (Kahan 1965): a step draws a few millionths of the charge, of which float32 would lose much.
    drawn = current / (3600.0 * data.core.freq * battery.capacity) + battery.rounding
    charge = battery.charge - drawn
    rounding = drawn - (battery.charge - charge)
    empty = charge <= 0
    battery = battery.replace(
        charge=jnp.where(empty, 0.0, charge),
        rounding=jnp.where(empty, 0.0, rounding),
        voltage=voltage,
        current=current,
    )
    return data.replace(plugins=data.plugins | {"battery": battery})


def open_circuit_voltage(charge: Array, n_cells: int) -> Array:
    """Return the voltage of lithium-polymer cells in series without load, V.

    Chen and Rincon-Mora 2006 (IEEE Trans. Energy Conversion 21(2)), equation 2, fitted to one cell: 4.10 V when full,
    3.8 V at half charge, with a steep fall below a tenth.

    Args:
        charge: State of charge, 0 to 1. (..., 1)
        n_cells: Number of cells.
    """
    polynomial = 3.685 + charge * (0.2156 + charge * (-0.1178 + charge * 0.3201))
    return n_cells * (polynomial - 1.031 * jnp.exp(-35.0 * charge))


def under_load(power: Array, open_circuit: Array, resistance: Array) -> tuple[Array, Array]:
    """Return voltage and current of a source with internal resistance that gives a power, V and A.

    The upper root of ``V = V_0 - R P / V``. No more than ``V_0^2 / (4 R)`` can be had: the load that asks for more gets
    just that, at half the open-circuit voltage.

    Args:
        power: Power asked for, W. (..., 1)
        open_circuit: Voltage without load, V. (..., 1)
        resistance: Internal resistance, ohm. (..., 1)
    """
    spare = open_circuit * open_circuit - 4 * resistance * power
    enough = spare > 0
    root = jnp.where(enough, jnp.sqrt(jnp.where(enough, spare, 1.0)), 0.0)
    voltage = 0.5 * (open_circuit + root)
    most = open_circuit * open_circuit / (4 * resistance)
    return voltage, jnp.where(enough, power, most) / voltage
