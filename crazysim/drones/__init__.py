"""Airframes: the constants of drone types, one TOML file each."""

from crazysim.drones.airframe import Airframe, AirframeSource, Drone, airframe_names
from crazysim.drones.airframe_estimate import estimate_airframe
from crazysim.drones.loading import load_airframe

__all__ = ["Airframe", "AirframeSource", "Drone", "airframe_names", "estimate_airframe", "load_airframe"]
