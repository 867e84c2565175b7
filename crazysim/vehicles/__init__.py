"""Ground vehicles: cars, bicycles and trailers, paths on the ground, and controllers that follow them."""

from crazysim.vehicles.car_data import CarData
from crazysim.vehicles.cars import Bicycles, Cars
from crazysim.vehicles.commonroad import CommonRoadParams, CommonRoadState, commonroad_single_track
from crazysim.vehicles.following import PathController, PathState, PurePursuit, Stanley
from crazysim.vehicles.kinematic import kinematic
from crazysim.vehicles.lpv import LPV
from crazysim.vehicles.model import VehicleModel, load_vehicle, vehicle_names
from crazysim.vehicles.parameters import CarParams
from crazysim.vehicles.path import Path, PathPoint
from crazysim.vehicles.path_lqr import PathLQR
from crazysim.vehicles.single_track import single_track
from crazysim.vehicles.state import CarState, ackermann

__all__ = [
    "LPV",
    "Bicycles",
    "CarData",
    "CarParams",
    "CarState",
    "Cars",
    "CommonRoadParams",
    "CommonRoadState",
    "Path",
    "PathController",
    "PathLQR",
    "PathPoint",
    "PathState",
    "PurePursuit",
    "Stanley",
    "VehicleModel",
    "ackermann",
    "commonroad_single_track",
    "kinematic",
    "load_vehicle",
    "single_track",
    "vehicle_names",
]
