"""Airframes: the constants of drone types, one TOML file each."""

from crazysim.drones.airframe import Airframe, Drone, airframe_names, load_airframe

__all__ = ["Airframe", "Drone", "airframe_names", "load_airframe"]
