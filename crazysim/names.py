"""Public names that are imported at their first use, and the modules that define them.

The packages below import their names from here, so that ``import crazysim`` loads a few modules only. Names of the
laboratory are public in the simulator's packages too: this table is the only module of the simulator that leads there.
A module of the table without a file exists for its names alone, such as the modules of Crazyflow. It is made by the
finder at the end.
"""

from __future__ import annotations

import importlib
import importlib.abc
import importlib.machinery
import sys
from collections.abc import Callable, Sequence
from types import ModuleType
from typing import Any

NAMES: dict[str, dict[str, str]] = {
    "crazysim": {
        "crazysim.core": "functional",
        "crazysim.envs": "make",
        "crazysim.lab.bodies.drone_collisions": "DroneCollisions",
        "crazysim.lab.bodies.free_bodies": "FreeBodies",
        "crazysim.lab.control.mppi": "MPPI",
        "crazysim.lab.estimators.eskf": "ESKF",
        "crazysim.lab.plugins.radar": "Radar",
        "crazysim.lab.plugins.random_airframe": "RandomAirframe",
        "crazysim.lab.plugins.residual": "Residual",
        "crazysim.lab.plugins.rotor_jet": "RotorJet",
        "crazysim.lab.plugins.shared_load": "SharedLoad",
        "crazysim.lab.scene.splats": "SplatScene",
        "crazysim.lab.vehicles.cars": "Bicycles Cars",
        "crazysim.plugins.contacts.contact_log": "ContactLog",
        "crazysim.plugins.contacts.response": "ContactResponse",
        "crazysim.plugins.contacts.terrain": "Terrain",
        "crazysim.plugins.effects": "Battery Downwash GroundEffect Latency MotorFailure Randomize "
        "RotorAerodynamics Wind WindField",
        "crazysim.plugins.estimators.kalman": "Kalman",
        "crazysim.plugins.follow": "Follow",
        "crazysim.plugins.payloads": "Hook SlungLoad",
        "crazysim.plugins.scenery": "Clutter Forest Gates Maps Pillars Rooms",
        "crazysim.plugins.sensors": "Camera IMU Lidar MotionCapture RangeFinder Sensor",
    },
    "crazysim.control": {
        "crazysim.control.auto": "Auto",
        "crazysim.control.geometric": "Geometric geometric_control",
        "crazysim.control.indi": "INDI indi_control",
        "crazysim.lab.control.any_airframe": "AnyAirframe",
        "crazysim.lab.control.firmware": "CFirmware",
        "crazysim.lab.control.load_lqr": "LoadLQR load_lqr_control",
        "crazysim.lab.control.lqr": "LQR lqr_control",
        "crazysim.lab.control.tracking_lqr": "TrackingLQR tracking_lqr_control",
        "crazysim.sim.crazyflow": "load_fn_params load_params",
    },
    "crazysim.engine": {
        "crazysim.engine.plan": "ENGINES",
        "crazysim.engine.step": "Step",
        "crazysim.engine.tools.explain": "explain",
    },
    "crazysim.envs": {
        "crazysim.envs.brax": "BraxEnv",
        "crazysim.envs.pettingzoo": "make_parallel",
        "crazysim.envs.race_clock": "RaceClock time_flight",
        "crazysim.envs.rsl_rl": "RslRlEnv",
        "crazysim.envs.sb3": "DroneVecEnv",
        "crazysim.envs.track_files": "load_track track_names",
        "crazysim.envs.tracks": "Track gates_of_track",
    },
    "crazysim.plugins.bodies": {"crazysim.lab.bodies.free_bodies": "FreeBodies FreeBodiesData"},
    "crazysim.plugins.effects": {
        "crazysim.lab.plugins.random_airframe": "RandomAirframe",
        "crazysim.lab.plugins.residual": "Residual",
    },
    "crazysim.plugins.estimators": {
        "crazysim.lab.estimators.complementary": "Complementary",
        "crazysim.lab.estimators.eskf": "ESKF",
    },
    "crazysim.plugins.payloads": {
        "crazysim.lab.control.load_flatness": "LoadedState load_flat_state",
        "crazysim.lab.plugins.jet_table": "JetTable load_jet_table",
        "crazysim.lab.plugins.rotor_jet": "RotorJet",
        "crazysim.lab.plugins.shared_load": "SharedLoad",
    },
    "crazysim.plugins.sensors": {
        "crazysim.lab.plugins.radar": "Radar",
        "crazysim.plugins.sensors.barometer": "Barometer",
        "crazysim.plugins.sensors.beacons": "Lighthouse UWB",
        "crazysim.plugins.sensors.camera": "Camera",
        "crazysim.plugins.sensors.depth_errors": "Distortion StereoNoise",
        "crazysim.plugins.sensors.errors": "Constant GaussMarkov Link Rounded Turned White",
        "crazysim.plugins.sensors.flow_deck": "OpticalFlow TimeOfFlight",
        "crazysim.plugins.sensors.gps": "GPS",
        "crazysim.plugins.sensors.image_sensor": "ImageData ImageSensor",
        "crazysim.plugins.sensors.imu": "IMU",
        "crazysim.plugins.sensors.lidar": "Lidar",
        "crazysim.plugins.sensors.magnetometer": "Magnetometer",
        "crazysim.plugins.sensors.motion_capture": "MotionCapture",
        "crazysim.plugins.sensors.onboard": "BatteryVoltage MultiRanger RotorSpeeds",
        "crazysim.plugins.sensors.range_finder": "RangeFinder",
        "crazysim.plugins.sensors.sensor": "Samples Sensor",
        "crazysim.plugins.sensors.triad": "Triad",
        "crazysim.scene.appearance": "RandomColors",
        "crazysim.scene.depth": "RandomPose",
    },
    "crazysim.plugins.vehicles": {
        "crazysim.lab.vehicles.car_params": "CarParams",
        "crazysim.lab.vehicles.car_state": "CarState ackermann",
        "crazysim.lab.vehicles.cars": "Bicycles CarData Cars",
        "crazysim.lab.vehicles.commonroad": "CommonRoadParams CommonRoadState commonroad_single_track",
        "crazysim.lab.vehicles.following": "PathController PathState PurePursuit Stanley",
        "crazysim.lab.vehicles.kinematic": "kinematic",
        "crazysim.lab.vehicles.lpv": "LPV",
        "crazysim.lab.vehicles.model": "VehicleModel load_vehicle vehicle_names",
        "crazysim.lab.vehicles.path": "Path PathPoint",
        "crazysim.lab.vehicles.path_lqr": "PathLQR",
        "crazysim.lab.vehicles.single_track": "single_track",
    },
    "crazysim.scene": {
        "crazysim.lab.scene.maps": "map_spec",
        "crazysim.lab.scene.splat_images": "build_splat_fn",
    },
    "crazysim.sim.export": {"crazysim.lab.export.casadi": "to_casadi"},
    "crazysim.train": {
        "crazysim.train.check": "check_task",
        "crazysim.train.config": "TrainConfig",
        "crazysim.train.dagger": "imitate",
        "crazysim.train.evaluation": "evaluate evaluate_each",
        "crazysim.train.networks": "Network",
        "crazysim.train.policies": "MultiPolicy",
        "crazysim.train.runs": "run run_many",
        "crazysim.train.search": "tune",
        "crazysim.train.show": "film plot_episode",
        "crazysim.train.training": "load_policy",
    },
    "crazysim.train.export": {
        "crazysim.lab.export.betaflight": "to_betaflight",
        "crazysim.lab.export.cost": "cost_text",
        "crazysim.lab.export.mc_nn_control": "observe_inputs to_mc_nn_control",
        "crazysim.lab.export.out_of_tree": "to_out_of_tree",
        "crazysim.lab.export.policies": "to_c to_onnx",
        "crazysim.lab.export.rl_tools": (
            "find_weights raptor_order raptor_policy raptor_weights read_rl_tools shipped_weights to_rl_tools "
            "weights_to_c"
        ),
        "crazysim.lab.export.tflite": "to_tflite",
    },
    "crazysim.trajectories": {
        "crazysim.lab.planning.approaches": "Approach",
        "crazysim.lab.planning.limits": "Limits Report Violation check",
        "crazysim.lab.planning.waypoints": "minimum_jerk minimum_snap smoothest",
        "crazysim.lab.racing.time_optimal": "Plan fly_open_loop plan_race",
        "crazysim.lab.trajectory_files.csv": "load_csv save_csv save_samples",
        "crazysim.lab.trajectory_files.polynomials": "pack_compressed",
    },
    "crazysim.trajectories.files": {
        "crazysim.lab.trajectory_files.csv": "load_csv save_csv save_samples",
        "crazysim.lab.trajectory_files.polynomials": "load_memory pack_compressed pack_poly4d save_memory "
        "unpack_compressed unpack_poly4d",
    },
    # Modules of Crazyflow.
    "crazysim.control.parameters": {"crazysim.sim.crazyflow": "load_fn_params load_params"},
    "crazysim.dynamics.utils": {},
    "crazysim.dynamics.utils.data_utils": {
        "crazysim.lab.identify.attitude_logs": "derivatives_svf preprocessing state_variable_filter",
    },
    "crazysim.dynamics.utils.identification": {
        "crazysim.lab.identify.fitted": "sys_id_rotation sys_id_translation",
    },
    "crazysim.exception": {
        "crazysim.errors": "ConfigError RenderError UnknownNameError",
        "crazysim.sim.crazyflow": "CrazyflowError",
    },
    "crazysim.sim.data": {
        "crazysim.control": "Control",
        "crazysim.core.controls": "AttitudeControlData BodyRateControlData ForceTorqueControlData SimControls "
        "StateControlData",
        "crazysim.core.data": "SimCore SimData SimParams SimState SimStateDeriv",
        "crazysim.sim.crazyflow": "ControlData",
    },
    "crazysim.sim.dynamics": {
        "crazysim.sim.crazyflow": "first_principles_dynamics so_rpy_dynamics so_rpy_rotor_drag_dynamics "
        "so_rpy_rotor_dynamics",
    },
    "crazysim.sim.functional": {
        "crazysim.core.functional": "attitude_control body_rate_control controllable force_torque_control "
        "rotor_vel_control state_control",
    },
    "crazysim.sim.integration": {"crazysim.core.integration": "Integrator euler rk4 symplectic_euler"},
    "crazysim.sim.pipeline": {
        "crazysim.core.pipeline": "Pipeline append_fn insert_fn_after insert_fn_before prepend_fn remove_fn replace_fn",
    },
    "crazysim.sim.sensors": {},
    "crazysim.sim.sensors.depth": {"crazysim.sim.crazyflow": "render_depth"},
    "crazysim.sim.sensors.splat": {
        "crazysim.lab.scene.crazyflow_splats": "build_render_splat_fn build_render_splat_rgbd_fn camera_intrinsics "
        "render_splat_rgb render_splat_rgbd viewmats",
    },
    "crazysim.sim.sharding": {"crazysim.engine.sharding": "shard shardings_of world_mesh"},
    "crazysim.sim.splat": {"crazysim.lab.scene.crazyflow_splats": "attach_splats"},
    "crazysim.utils": {
        "crazysim.core.data": "grid_2d",
        "crazysim.engine.cache": "enable_cache",
        "crazysim.engine.pytree": "CORE_NDIM_KEY",
        "crazysim.sim.crazyflow": "leaf_replace pytree_replace world_mask",
    },
}
"""Names by package or module, and by the module that defines them."""


def lazy_getattr(module: str) -> Callable[[str], Any]:
    """Make the ``__getattr__`` of a package, which imports its names of the table at their first use.

    ``dir`` of the package lists these names and its others in ``__all__``.
    """
    origins = {name: origin for origin, names in NAMES[module].items() for name in names.split()}
    namespace = vars(sys.modules[module])
    namespace["__dir__"] = lambda: sorted({*namespace.get("__all__", ()), *origins})

    def import_name(name: str) -> Any:
        if name not in origins:
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        return getattr(importlib.import_module(origins[name]), name)

    return import_name


class _ModuleFinder(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Finder of the modules of the table that have no file."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        del path, target
        return importlib.machinery.ModuleSpec(fullname, self, is_package=True) if fullname in NAMES else None

    def exec_module(self, module: ModuleType) -> None:
        module.__dict__["__getattr__"] = lazy_getattr(module.__name__)
        module.__dict__["__all__"] = " ".join(NAMES[module.__name__].values()).split()


sys.meta_path.append(_ModuleFinder())
