"""Law 9 for what a plugin's settings, its simulation and other plugins forbid together.

``tests/laws/test_law_09_wrong_numbers.py`` tests the type, range and shape of every number.
"""

import re

import numpy as np
import pytest

from crazysim import (
    IMU,
    Battery,
    Camera,
    Cars,
    Clutter,
    ConfigError,
    ContactResponse,
    Downwash,
    DroneCollisions,
    Follow,
    Forest,
    FreeBodies,
    Gates,
    GroundEffect,
    Hook,
    Kalman,
    Latency,
    Lidar,
    MotionCapture,
    MotorFailure,
    Pillars,
    Randomize,
    RangeFinder,
    Residual,
    Rooms,
    RotorAerodynamics,
    SharedLoad,
    Sim,
    SlungLoad,
    Terrain,
    Wind,
    WindField,
    load_airframe,
    make,
)
from crazysim.envs import DroneEnv
from crazysim.plugins import sensors
from crazysim.plugins.effects import Grid
from crazysim.plugins.estimators import ESKF, Complementary
from crazysim.plugins.sensors import UWB, Barometer, Distortion, Lighthouse, Magnetometer, Triad
from crazysim.plugins.vehicles import LPV, Path, PurePursuit, load_vehicle
from crazysim.trajectories import Trajectory, figure_eight, hover, line, spline

POINT = (0.0, 0.0, 2.0)


def sim(*plugins, **settings):
    """Return a simulation; plugins are added one after another."""
    sim = Sim(**{"control": "rotor_vel"} | settings)
    for plugin in plugins:
        sim.add(plugin)
    return sim


def measure_without_sensors(env):
    return DroneEnv(env.sim, env.task, measured=True)


SENSORS = [
    (lambda: Camera(outputs=()), "outputs of 'camera'"),
    (lambda: Camera(outputs=("hue",)), "got ('hue',)"),
    (lambda: Camera(outputs=[[1], [2, 3]]), "outputs"),
    (lambda: Lidar(outputs=[[1], [2, 3]]), "outputs"),
    (lambda: Lidar(outputs=("depth",)), "lidar without 'depth'"),
    (lambda: Lidar(outputs=("rgb",)), "no axis, colours"),
    (lambda: Lidar(elevation=()), "elevation and azimuth"),
    (lambda: Camera(fovy=180.0), "fovy of Camera"),
    (lambda: Camera(noise=0.1), "StereoNoise"),
    (lambda: Camera(fovy=120.0, distortion=Distortion(k1=-0.5)).rays, "folds the image"),
    (lambda: sim(Camera(freq=333)), "Use the nearest rate below, 250 Hz"),
    (lambda: sim(Camera(latency=1.0)), "latency of 'camera' of at most 63 images"),
    (lambda: sim(Camera(10**6, 10**6)), "1 images of 1000000 x 1000000 pixels"),
    (lambda: sim(Lidar(np.zeros(10**5), np.zeros(10**6))), "1 images of 1000000 x 100000 pixels"),
    (lambda: sim().depth("fpv_cam", 10**6, 10**6), "1 images of 1000000 x 1000000 pixels"),
    (lambda: Camera().read(sim().data), "a record of plugin 'camera'"),
    (lambda: sim(IMU(accel=Triad(bias=(0.0, 1.0)))), "bias of accel"),
    (lambda: sim(IMU(imbalance=1e-8), dynamics="so_rpy", control="attitude"), "single rotors"),
    (lambda: sim(UWB([POINT], tdoa=True)), "anchors as at least 2"),
    (lambda: sim(Lighthouse([POINT], [POINT, POINT])), "rpy of shape"),
    (lambda: sim(Magnetometer((0, 20, -45))), "Use 20e-6 for 20 microtesla"),
    (lambda: sim(sensors.BatteryVoltage()), "a Battery named"),
    (lambda: sim(sensors.MultiRanger()), "a RangeFinder named"),
    (lambda: sim(RangeFinder([(0, 0, 1)]), sensors.MultiRanger()), "n_rays = 1"),
    (lambda: sim(sensors.RotorSpeeds(n_rotors=6)), "n_rotors = 4"),
    (lambda: sensors.RotorSpeeds.telemetry(0), "pole_pairs"),
    (lambda: sim(MotionCapture(freq=333)), "freq of 'motion_capture'"),
    (lambda: sim(MotionCapture(delay=1.0, freq=100)), "delay of 'motion_capture' of zero to 62 measurements"),
    (lambda: sim(MotionCapture(delay=0.4, jitter=0.4, freq=100)), "62 measurements, with its jitter, got 0.8"),
    (lambda: sim(MotionCapture(delay=0.02, max_delay=0.01)), "delay"),
    (lambda: sim(Barometer(freq=60), freq=250), "freq of 'barometer' to divide freq = 250 Hz, got 60"),
    (lambda: make("hover", sensors=IMU()), "Use sensors=[IMU"),
    (lambda: make("hover", sensors="imu"), "sensors as a list of plugins"),
    (lambda: make("hover", effects=Battery()), "effects as a list of plugins"),
    (lambda: make("hover", sensors=[MotionCapture()], estimator="kalman"), "estimator=Kalman"),
    (lambda: measure_without_sensors(make("hover")), "a sensor of states"),
]


IMU_AND_CAMERA = [IMU(), MotionCapture()]
ESTIMATORS = [
    (lambda: sim(estimator="ekf"), "an estimator as one of 'kalman'"),
    (lambda: sim(estimator=Kalman), "an estimator as one of 'kalman'"),
    (lambda: Kalman(IMU()), "Use Kalman([IMU(), MotionCap"),
    (lambda: Kalman(["imu"]), "Use Kalman([IMU(), MotionCap"),
    (lambda: sim(Kalman([])), "one IMU"),
    (lambda: sim(IMU(), Kalman([IMU(), Barometer()])), "got Barometer"),
    (lambda: sim(IMU(), Kalman(IMU_AND_CAMERA)), "Use sim.add"),
    (lambda: sim(IMU(), Kalman([IMU()], deviations={"speed": 1.0})), "got 'speed'"),
    (lambda: sim(estimator=ESKF([IMU(), sensors.RotorSpeeds()])), "got RotorSpeeds"),
    (lambda: sim(estimator="complementary", control="state"), "estimates no position"),
    (lambda: sim(estimator=Complementary([IMU()]), control="attitude"), "a TimeOfFlight or one of each"),
]
LINEAR, HIDDEN = np.zeros((6, 14)), np.zeros((5, 14))
WITHOUT_BATTERY = {key: load_airframe("cf21B_500").tables[key] for key in ("rigid_body", "rotors", "drag")}


def drone(**residual):
    return {"base": "cf21B_500", "residual": {key: x.tolist() for key, x in residual.items()}}


def heavier_drone():
    return {"base": drone(linear=LINEAR), "rigid_body": {"mass": 0.05}}


def fleet():
    return [drone(linear=LINEAR), drone(linear=LINEAR, hidden=HIDDEN, output=np.zeros((6, 5)))]


def fitted(plugin):
    return sim(plugin, dynamics="so_rpy", control="attitude")


def randomized(*plugins, **settings):
    sim(*plugins, **settings).step()


EFFECTS = [
    (lambda: sim(Battery(), drone=WITHOUT_BATTERY), "Add capacity to its table [battery]"),
    (lambda: sim(Latency(delay=6, max_delay=5)), "delay"),
    (lambda: fitted(Wind((1.0, 0, 0))), "Wind acts through drag"),
    (lambda: fitted(WindField(Grid(np.zeros((1, 1, 1, 3))))), "WindField acts through drag"),
    (lambda: fitted(Downwash()), "Downwash acts through drag"),
    (lambda: fitted(GroundEffect()), "first_principles"),
    (lambda: fitted(MotorFailure()), "first_principles"),
    (lambda: fitted(RotorAerodynamics()), "first_principles"),
    (lambda: fitted(Randomize.crazyflie()), "first_principles"),
    (lambda: sim(Wind((1.0, 0, 0)), drone="bumblebee"), "Wind acts through drag"),
    (lambda: sim(Wind((1.0, 0, 0), roughness=0.05, exponent=0.2)), "got both"),
    (lambda: sim(Wind((1.0, 0, 0), roughness=7.0)), "roughness below the reference height"),
    (lambda: sim(WindField(np.zeros((2, 2, 2, 3)))), "field as a Grid"),
    (lambda: sim(WindField(Grid(np.zeros((2, 2, 2))))), "values of shape"),
    (lambda: sim(WindField(Grid(np.zeros((2, 2, 2, 2))))), "values of shape"),
    (lambda: sim(WindField(Grid(np.zeros((2, 2, 2, 3)), (0, 0)))), "an origin of shape"),
    (lambda: sim(WindField(Grid(np.zeros((2, 2, 2, 3)), spacing=0.0))), "spacing of field"),
    (lambda: sim(WindField(Grid(np.full((2, 2, 2, 3), np.nan)))), "finite"),
    (lambda: MotorFailure().fail(sim().data, np.ones((1, 1, 4), bool)), "motors is not enabled"),
    (lambda: sim(RotorAerodynamics(), drone="bumblebee"), "inflow="),
    (lambda: sim(RotorAerodynamics(inflow=2e-5)), "inflow below 1.49e-05"),
    (lambda: sim(RotorAerodynamics(inflow=0.0, ceiling=2.0)), "inflow above zero with a ceiling"),
    (lambda: sim(Residual()), "Use 'crazysim identify LOG"),
    (lambda: sim(Residual(), drone=fleet()), "number of hidden units"),
    (lambda: sim(Residual(), drone=heavier_drone()), "not inherited"),
    (lambda: sim(Residual(linear=LINEAR, hidden=HIDDEN)), "hidden and output together"),
    (lambda: sim(RotorAerodynamics(), Residual(), drone=drone(linear=LINEAR)), "and Residual 'residual'"),
    (lambda: sim(drone="cf2x_L250", aero="identified"), "crazysim identify LOG --airframe cf2x_L250"),
    (lambda: sim(aero=True), "Use plugins=[Rotor"),
    (lambda: sim(Randomize(mass=(1.1, 0.9))), "mass as (low, high), got (1.1, 0.9)"),
    (lambda: sim(Randomize(wind=0.1)), "Use (0.1, 0.1) for a fixed"),
    (lambda: sim(Randomize(mass=1.1)), "Use (low, high), or a number r"),
    (lambda: sim(Randomize(mass=(-1.0, 0.9))), "mass of Randomize"),
    (lambda: Randomize(optional=("foo",)), "optional as a list of mass, inertia, "),
    (lambda: Randomize(optional="wind"), "optional as a list of mass, inertia, "),
    (lambda: sim(Randomize(mass=(0.9, 1.0, 1.1))), "mass as real numbers of shape"),
    (lambda: sim(Randomize(wind=(0.0, 1.0)), drone="bumblebee"), "acts through drag"),
    (lambda: randomized(Latency(delay=2), Randomize(delay=(0, 4))), "Use Latency(delay=np.zeros"),
    (lambda: randomized(Randomize(charge=(0.1, 0.5))), "Use sim.add(Battery())"),
    (lambda: randomized(Randomize(delay=(0, 4))), "Use sim.add(Latency(delay=np.zeros((1, 1), int), max_delay=4))"),
    (lambda: randomized(Randomize(drag=(0.5, 1.5)), drone="bumblebee"), "Use sim.add(RotorAerodynamics"),
    (lambda: make("hover", effects=[Randomize(charge=(0.1, 0.5))]), "Use sim.add(Battery())"),
    (lambda: make("hover", randomize="crazyfly"), "got 'crazyfly'. Use effects="),
    (lambda: make("hover", randomize=5.0), "a fraction from 0 to 1, got 5"),
    (lambda: randomized(Randomize({"params.drag": 0.2})), "Near are params.drag_matrix"),
    (lambda: randomized(Randomize({"states.pos": 0.2})), "got 'states.pos', which is a state"),
    (lambda: randomized(Randomize({"core.steps": 0.2})), "which is a state, a whole number"),
    (lambda: randomized(Randomize({"plugins.randomize.limits": 0.2})), "got 'plugins.randomize.limits'"),
    (lambda: sim(Randomize({"params.mass": (1.1, 0.9)})), "params.mass as (low, high), got"),
    (lambda: sim(Randomize({"params.mass": 1.5})), "Use (low, high), or a number r for"),
    (lambda: sim(Randomize({"params.mass": (-1.0, 1.0)})), "paths['params.mass']"),
    (lambda: sim(Randomize({"params.mass": (0.9, 1.0, 1.1)})), "paths['params.mass']"),
    (lambda: sim(Randomize({"params.mass": "heavy"})), "params.mass"),
    (lambda: randomized(Randomize({3: 0.2})), "got '3'"),
    (lambda: sim(Randomize(("params.mass", 0.2))), "paths of Randomize"),
    (lambda: randomized(Randomize({"plugins.battery.efficiency": (1.5, 2.0)}), Battery()), "efficiency times 1.5"),
]  # fmt: skip
UP, EIGHT = line([0, 0, 1], [0, 1, 2], duration=1.0), figure_eight(period=4.0)


def follow(*args, **settings):
    sim(Follow(*args, **settings), control="state", n_drones=2)


def upload(slot, trajectory):
    plugin = Follow([UP, UP])
    plugin.upload(sim(plugin, control="state", n_drones=2), slot, trajectory)


PAYLOADS_AND_PATHS = [
    (lambda: sim(SlungLoad(0.1, size=(1, 2))), "size"),
    (lambda: sim(SlungLoad(0.1), SlungLoad(0.1, name="second")), "at most one plugin"),
    (lambda: sim(Hook(0.1, dof=3)), "dof"),
    (lambda: sim(SharedLoad(0.1), n_drones=2), "symplectic_euler"),
    (lambda: sim(Follow(EIGHT), control="attitude"), "control='state'"),
    (lambda: follow([]), "at least one"),
    (lambda: follow(3), "at least one trajectory, each of one vehicle, got 3"),
    (lambda: follow([Trajectory.stack([EIGHT, UP])]), "at least one"),
    (lambda: follow([EIGHT, UP], index=2), "index"),
    (lambda: follow([EIGHT, UP], n_slots=1), "n_slots"),
    (lambda: follow([EIGHT, UP], max_pieces=3), "max_pieces"),
    (lambda: upload(2, UP), "slot from 0 to 1"),
    (lambda: upload(0, EIGHT), "at most 1 pieces"),
]


def bodies(*args, **settings):
    sim(FreeBodies(*args, **settings))


def terrain(heights, size=(4.0, 3.0), **settings):
    return Terrain(heights, size, **settings)


SCENE = [
    (lambda: sim(DroneCollisions()), "at least two drones"),
    (lambda: sim(ContactResponse(softness=1e-3)), "softness to be from two steps, 0.004 s, to 10"),
    (lambda: sim(ContactResponse(objects="tree")), "got 'tree'"),
    (lambda: sim(ContactResponse(), ContactResponse()), "already"),
    (lambda: sim(ContactResponse(), terrain(np.ones((3, 3)))), "terrain before contact response"),
    (lambda: sim(terrain(np.zeros(4))), "two or more rows and columns"),
    (lambda: sim(terrain(np.zeros((3, 3)), (1.0, 1.0, 1.0))), "size as 2 positive lengths"),
    (lambda: sim(terrain(np.full((3, 3), -0.1))), "floor=False"),
    (lambda: sim(terrain(np.ones((3, 3)), name="floor")), "a new name"),
    (lambda: bodies(0), "members"),
    (lambda: bodies(2, size=[0.1]), "a list of 2"),
    (lambda: bodies(1, size=(0.1, 0.2)), "size"),
    (lambda: bodies(1, size="big"), "size as a number"),
    (lambda: bodies(10**7), "at most 100000 members of FreeBodies"),
    (lambda: bodies(2000), "at most 1000 bodies"),
    (lambda: bodies(400), "at most 250000 contact points in a world"),
    (lambda: bodies(1, quat=(0, 0, 0, 0)), "quat"),
    (lambda: bodies(2, pos=np.zeros((3, 3))), "pos"),
    (lambda: bodies(3, mass=[0.1, 0.2]), "mass"),
    (lambda: bodies(1, softness=0.001), "softness"),
    (lambda: bodies(1, objects="nothing"), "nothing"),
    (lambda: sim(FreeBodies(1), FreeBodies(["Ball_0"], name="more")), "one FreeBodies"),
    (lambda: sim(Forest(radii=(0.3, 0.1))), "the smallest before the largest size of 'forest'"),
    (lambda: sim(Forest(density=4.0)), "Use a lower density, or a smaller gap"),
    (lambda: sim(Forest(size=(1000.0, 1000.0))), "at most 10000 obstacles in Forest, got 62500"),
    (lambda: Forest(size=(1e30, 1e6)), "at most 10000 obstacles in Forest"),
    (lambda: sim(Forest(difficulty=1.5)), "difficulty"),
    (lambda: sim(Forest(difficulty=(0.8, 0.2))), "a range of difficulty, lowest first"),
    (lambda: Pillars(widths=(0.8, 0.3)), "the smallest before the largest size of 'pillars'"),
    (lambda: Clutter(sizes=(0.5, 0.2)), "sizes as smallest and largest"),
    (lambda: Clutter(density=2.0), "Use a lower density, or a smaller gap"),
    (lambda: Clutter(meshes=[[0.0, 1.0]]), "a mesh as corners (n, 3)"),
    (lambda: Clutter(meshes=0), "meshes as a list of corners (n, 3), m, got 0"),
    (lambda: Clutter(size=(1e30, 1e6, 1e6)), "at most 10000 obstacles in Clutter"),
    (lambda: Rooms(room=1e12), "at most 10000 obstacles in Rooms, got 7e+12. Use fewer"),
    (lambda: Rooms(door=1e-12), "at most 10000 obstacles in Rooms"),
    (lambda: Rooms(room=1.5, door=1.0), "rooms at least twice as wide as a door"),
    (lambda: Gates(start=(0, 0, 0.5)), "gates above the floor"),
]


def cars(**settings):
    return lambda: sim(Cars(**settings))


def vehicle(**tables):
    return lambda: load_vehicle({"base": "aiml_head", **tables})


def points(*corners, **settings):
    return lambda: Path.of_points(corners, **settings)


SQUARE, BACKWARDS = [(0, 0), (2, 0), (2, 2), (0, 2)], Path.of_points([(0, 0), (1, 0), (2, 0)], -1.0)
STRAIGHT, CORNER = (spline([0, 1], ends) for ends in ([(0, 0, 0), (1, 0, 0)], [(1, 0, 0), (0, 1, 0)]))
VEHICLES = [
    (cars(vehicle="tank"), "a vehicle as one of"),
    (cars(level="torque"), "level of 'cars'"),
    (cars(reference="place"), "reference of 'cars'"),
    (cars(controller=PurePursuit()), "a path for controller of 'cars'"),
    (cars(controller="lqr", path=EIGHT), "controller of Cars as PathController"),
    (cars(path="eight"), "a Path, a Trajectory"),
    (cars(path=EIGHT, index=1), "index to be from 0 to 0"),
    (cars(path=EIGHT, start=[0.0, 1.0]), "start as real numbers of shape (1,)"),
    (cars(path=EIGHT, vehicle="bicycle"), "a vehicle that steers"),
    (cars(vehicle="bicycle", trailer=True), "a table [trailer]"),
    (cars(path=BACKWARDS, controller=LPV()), "can drive forwards"),
    (cars(members=2, pos=[(0, 0, 0)]), "pos as real numbers of shape (2,)"),
    (cars(yaw=[0.0, 1.0]), "yaw as real numbers of shape (1,)"),
    (cars(freq=40), "to divide freq = 500 Hz"),
    (cars(members=["a", "a"]), "got 'a' twice"),
    (lambda: load_vehicle("f1tenth"), "aiml_apr24, aiml_head"),
    (lambda: load_vehicle(3), "a vehicle as a name"),
    (lambda: load_vehicle({"rigid_body": {"mass": 1.0}}), "which it lacks"),
    (lambda: load_vehicle("bicycle").number("trailer.hitch"), "has no value 'trailer.hitch'"),
    (vehicle(rigid_body={"mas": 1.0}), "Did you mean 'rigid_body.mass'"),
    (vehicle(wheel={"radius": 1.0}), "a table that exists"),
    (vehicle(rigid_body={"mass": 1e-300}), "rigid_body.mass"),
    (vehicle(rigid_body={"mass": [1.0, 2.0]}), "of shape"),
    (vehicle(wheels={"number": 0}), "wheels.number"),
    (vehicle(drive={"torque": [0, 5, 1]}), "drive.torque"),
    (vehicle(drive={"front_share": 1.5}), "drive.front_share"),
    (vehicle(drive={"force": [1, 1, 1], "torque": [1, 1, 1], "force_max": 1}), "either"),
    (vehicle(steering={"angle_max": 2.0}), "steering.angle_max"),
    (vehicle(steering={"bandwidth": np.inf}), "steering.bandwidth"),
    (vehicle(model="tank"), "single_track, kinematic"),
    (points((0, 0), (1, 1)), "at least three points"),
    (points((0, 0, 0), (1, 1, 0), (2, 0, 0)), "(n_points, 2)"),
    (points((0, 0), (1, 1), (1, 1)), "twice"),
    (points(*SQUARE, (0, 0), closed=True), "does not repeat its first point"),
    (points(*SQUARE, speed=0), "a speed other than zero"),
    (points((0, 0), (1e4, 0), (2e4, 1)), "a path of at most 10000 m"),
    (lambda: Path.of_trajectory(hover((0, 0, 1), 2.0)), "a path longer than 1 mm"),
    (lambda: Path.of_trajectory(STRAIGHT.then(CORNER)), "without a tangent at (1, 0) m"),
    (lambda: Path.of_trajectory(STRAIGHT.replace(repeats=np.bool_(True))), "a gap of 1 m"),
    (lambda: Path.stack([]), "at least one path"),
]
ROWS = [*SENSORS, *ESTIMATORS, *EFFECTS, *PAYLOADS_AND_PATHS, *SCENE, *VEHICLES]


@pytest.mark.parametrize(("call", "words"), ROWS, ids=[row[1] for row in ROWS])
def test_impossible_settings_are_errors_with_what_was_expected(call, words):
    with pytest.raises(ConfigError, match=re.escape(words)):
        call()
