"""Ground vehicles: cars, bicycles and trailers, paths on the ground, and controllers that follow them."""

from typing import TYPE_CHECKING

from crazysim.names import lazy_getattr

if TYPE_CHECKING:
    from crazysim.lab.vehicles.car_params import CarParams
    from crazysim.lab.vehicles.car_state import CarState, ackermann
    from crazysim.lab.vehicles.cars import Bicycles, CarData, Cars
    from crazysim.lab.vehicles.commonroad import CommonRoadParams, CommonRoadState, commonroad_single_track
    from crazysim.lab.vehicles.following import PathController, PathState, PurePursuit, Stanley
    from crazysim.lab.vehicles.kinematic import kinematic
    from crazysim.lab.vehicles.lpv import LPV
    from crazysim.lab.vehicles.model import VehicleModel, load_vehicle, vehicle_names
    from crazysim.lab.vehicles.path import Path, PathPoint
    from crazysim.lab.vehicles.path_lqr import PathLQR
    from crazysim.lab.vehicles.single_track import single_track

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

__getattr__ = lazy_getattr(__name__)
