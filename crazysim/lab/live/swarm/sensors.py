"""Readings of a drone's plugins, as the decks and the power management of a Crazyflie report them."""

from __future__ import annotations

import math
from typing import NamedTuple, TypeVar

import numpy as np

from crazysim.plugins.effects import Battery
from crazysim.plugins.sensors import MultiRanger
from crazysim.plugins.sensors.range_finder import MULTI_RANGER_DIRECTIONS, RangeFinder
from crazysim.sim.sim import Sim

ON_BATTERY, LOW_POWER = 0, 3
"""States of the power management (pm.h of crazyflie-firmware)."""
LOW_VOLTAGE = 3.2
"""Voltage of a cell below which the power is low, V (``DEFAULT_BAT_LOW_VOLTAGE`` in platform_defaults_cf2.h)."""
IDEAL_VOLTAGE = 4.0
"""Voltage that drones without the plugin ``Battery`` report, V."""

P = TypeVar("P")


class BatteryState(NamedTuple):
    """State of a battery."""

    voltage: float
    """Voltage, V."""
    charge: float
    """State of charge, 0 to 1."""
    state: int
    """State of the power management."""


def read_battery(sim: Sim, drone: int) -> BatteryState:
    """Return the state of a drone's ``Battery``; without the plugin, of a battery that is never empty."""
    plugin = _find_plugin(sim, Battery)
    if plugin is None:
        return BatteryState(IDEAL_VOLTAGE, 1.0, ON_BATTERY)
    record = plugin.read(sim.data)
    voltage, charge = float(record.voltage[0, drone, 0]), float(record.charge[0, drone, 0])
    return BatteryState(voltage, charge, LOW_POWER if voltage < LOW_VOLTAGE * record.n_cells else ON_BATTERY)


def read_ranges(sim: Sim, drone: int) -> dict[str, float]:
    """Return distances from a ``MultiRanger`` or ``RangeFinder``, m, by direction (``MULTI_RANGER_DIRECTIONS``).

    A distance is infinite if no object is within range. Directions that the sensor does not have are missing; without a
    sensor the result is empty. Before the first measurement of a ``MultiRanger``, the distances have no errors.
    """
    ranger = _find_plugin(sim, MultiRanger)
    plugin = _find_plugin(sim, RangeFinder) if ranger is None else sim.plugins[ranger.range_finder]
    if plugin is None:
        return {}
    record = plugin.read(sim.data)
    max_range, distances = float(record.max_range), np.asarray(record.distance)[0, drone].tolist()
    if ranger is not None:
        samples = ranger.read(sim.data).samples
        if samples.taken_step[0, drone, 0] >= 0:
            distances = np.asarray(samples.value)[0, drone].tolist()
    ranges = {}
    for direction, distance in zip(np.asarray(record.direction), distances, strict=True):
        name = next(
            (name for name, axis in MULTI_RANGER_DIRECTIONS.items() if np.allclose(axis, direction, atol=1e-6)), None
        )
        if name is not None:
            ranges[name] = distance if distance < max_range else math.inf
    return ranges


def _find_plugin(sim: Sim, kind: type[P]) -> P | None:
    return next((plugin for plugin in sim.plugins.values() if isinstance(plugin, kind)), None)
