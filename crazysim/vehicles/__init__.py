"""Ground vehicles: models of cars, bicycles and trailers."""

from crazysim.vehicles.kinematic import kinematic
from crazysim.vehicles.model import VehicleModel, load_vehicle, vehicle_names
from crazysim.vehicles.parameters import CarParams
from crazysim.vehicles.single_track import single_track
from crazysim.vehicles.state import CarState, ackermann

__all__ = [
    "CarParams",
    "CarState",
    "VehicleModel",
    "ackermann",
    "kinematic",
    "load_vehicle",
    "single_track",
    "vehicle_names",
]
