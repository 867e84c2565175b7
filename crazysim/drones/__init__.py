"""Airframes: the constants of drone types, one TOML file each."""

from crazysim.drones.airframe import Airframe, Drone, airframe_names, load_airframe
from crazysim.drones.estimate import estimate_airframe

__all__ = ["Airframe", "Drone", "airframe_names", "estimate_airframe", "load_airframe"]
